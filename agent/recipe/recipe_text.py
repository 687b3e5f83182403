"""The commented recipe that `agent init` writes, `template.yaml` filled in."""

from __future__ import annotations

import re
from importlib.resources import files

from agent.motion import create_dialect
from drivers import registry

_BARE = re.compile(r"[0-9]+(\.[0-9]+){3}:[0-9]+|[A-Za-z_][A-Za-z0-9_./-]*(:[0-9]+)?")


#: Values of the template, as texts in the file's units.
USUAL = {
    "robot": "comau_ns16",
    "driver": "tcp",
    "address": "127.0.0.1:9100",
    "count": "6",
    "centre": "1.0 m, 0 m, 0.8 m",
    "size": "500 mm, 600 mm, 400 mm",
    "orientation": "0 deg, 180 deg, 0 deg",
    "cone": "30 deg",
    "cycles": "100",
}


def template(robot: str = USUAL["robot"], address: str = USUAL["address"], **values: str | int) -> str:
    """Text of a commented recipe that `load_recipe` reads, with `values` in place of the usual ones."""
    chosen = {**USUAL, **values, "robot": robot, "address": address}
    texts = {key: _scalar(str(chosen[key])) for key in ("robot", "driver", "address")}
    dialect, efforts = create_dialect(registry.dialect(str(chosen["driver"]))), registry.efforts(str(chosen["driver"]))
    texts["fly"] = "type: FLY_CART, trajectory: FLY_TOL, " if "trajectory" in dialect.fly_keys else ""
    texts["interpolator"] = dialect.interpolators[0]
    texts["effort"] = f", effort: {efforts[0]}" if efforts else ""
    texts["efforts"] = f"   # what this robot reports: {', '.join(efforts)}" if efforts else ""
    return (files("agent.recipe") / "template.yaml").read_text(encoding="utf-8").format(**{**chosen, **texts})


def _scalar(text: str) -> str:
    """A YAML scalar: bare where it cannot be taken for anything else, else quoted and escaped."""
    if _BARE.fullmatch(text) and text.lower() not in ("true", "false", "null", "yes", "no", "on", "off"):
        return text
    return '"' + "".join(c if " " <= c <= "~" and c not in '"\\' else f"\\U{ord(c):08x}" for c in text) + '"'
