"""Recipes: one validated object per file, SI inside. Millimetres and degrees end here."""

from agent.recipe.recipe import (
    Cell,
    MotionPlan,
    Recipe,
    examine_recipe,
    load_recipe,
    recipe_schema,
)
from agent.recipe.template import template
from agent.recipe.via_points import ViaBox, ViaLike, ViaPoint, ViaPointList, ViaTube

__all__ = [
    "Cell",
    "MotionPlan",
    "Recipe",
    "ViaBox",
    "ViaLike",
    "ViaPoint",
    "ViaPointList",
    "ViaTube",
    "examine_recipe",
    "load_recipe",
    "recipe_schema",
    "template",
]
