"""Markup: templates and other texts in the `assets` of a package."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader


@cache
def _environment(package: str) -> Environment:
    loader = PackageLoader(package, "assets")
    return Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)


def filled(package: str, template: str, **values: Any) -> str:
    """A template of a package with these values in it, escaped."""
    return _environment(package).get_template(template).render(**values)


def asset(package: str, name: str) -> str:
    """A text as it is."""
    return (files(package) / "assets" / name).read_text(encoding="utf-8")
