"""Recipes: one validated object per file, SI inside. Millimetres and degrees end here."""

from agent.recipe.recipe import (
    CellDescription,
    MotionPlan,
    Recipe,
    examine_recipe,
    load_recipe,
    recipe_schema,
)
from agent.recipe.recipe_text import template
from agent.recipe.via_points import ViaBox, ViaLike, ViaPointList, ViaPointRegion, ViaTube

__all__ = [
    "CellDescription",
    "MotionPlan",
    "Recipe",
    "ViaBox",
    "ViaLike",
    "ViaPointList",
    "ViaPointRegion",
    "ViaTube",
    "examine_recipe",
    "load_recipe",
    "recipe_schema",
    "template",
]
