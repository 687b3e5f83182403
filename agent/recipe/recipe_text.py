"""The commented recipe that `agent init` writes, `template.yaml` filled in."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.resources import files

_BARE = re.compile(r"[0-9]+(\.[0-9]+){3}:[0-9]+|[A-Za-z_][A-Za-z0-9_./-]*(:[0-9]+)?")


def template(
    robot: str = "comau_ns16",
    address: str = "127.0.0.1:9100",
    driver: str = "tcp",
    count: int = 6,
    centre: Sequence[str] = ("1.0 m", "0 m", "0.8 m"),
    size: Sequence[str] = ("500 mm", "600 mm", "400 mm"),
    orientation: Sequence[str] = ("0 deg", "180 deg", "0 deg"),
    cone: str = "30 deg",
    cycles: int = 100,
) -> str:
    """Text of a commented recipe that `load_recipe` reads. Quantities are texts with units, as in the file."""
    text = (files("agent.recipe") / "template.yaml").read_text(encoding="utf-8")
    return text.format(
        robot=_scalar(robot),
        driver=_scalar(driver),
        address=_scalar(address),
        count=count,
        centre=", ".join(centre),
        size=", ".join(size),
        orientation=", ".join(orientation),
        cone=cone,
        cycles=cycles,
    )


def _scalar(text: str) -> str:
    """A YAML scalar: bare where it cannot be taken for anything else, else quoted and escaped."""
    if _BARE.fullmatch(text) and text.lower() not in ("true", "false", "null", "yes", "no", "on", "off"):
        return text
    return '"' + "".join(c if " " <= c <= "~" and c not in '"\\' else f"\\U{ord(c):08x}" for c in text) + '"'
