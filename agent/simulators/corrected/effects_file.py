"""The effects of a corrected simulator as a Python file of their own: `standalone_effects` with the data filled in."""

from __future__ import annotations

import math
import pprint
from pathlib import Path
from typing import Any

import numpy as np

from agent.model import CATALOGUE, N_NODES, ModelEffect
from agent.simulators.corrected import standalone_effects
from agent.simulators.corrected.correction import Correction

_FORMS = (*(name[1:] for name in vars(standalone_effects.Effects) if name[1:] in CATALOGUE),)
_OTHERS = ("joint_elasticity", "backlash", "wrist_coupling", "torque_constant", "torque_offset", "time_delay")


def is_supported(entry: ModelEffect) -> bool:
    """Whether the file has a form for an effect: all built-in ones that are part of a simulator, none installed."""
    ahead = entry.effect == "time_delay" and entry.parameters["delay"] <= 0
    return entry.effect in (*_FORMS, *_OTHERS) and not ahead


def effects_text(correction: Correction, source: str, out: str) -> str | None:
    """The file's text; None where the simulator's file says everything."""
    effects = [_entry(correction, entry) for entry in correction.effects if is_supported(entry)]
    arm, n = correction.arm, len(correction.arm.joint_names)
    unsaid = arm.armature if arm.is_urdf else np.zeros(n)
    if not effects and not np.any(unsaid):
        return None
    reversal = [term.reversal.scale for term in correction.model.terms if term.form == "coulomb" and term.reversal]
    data = {
        "JOINTS: tuple[str, ...]": arm.file_joints,
        "REVERSAL: tuple[float, ...]": tuple(map(float, reversal)),
        "ROTORS: tuple[float, ...]": tuple(map(float, arm.armature)),
        "ARMATURE: tuple[float, ...]": tuple(map(float, unsaid)),
        "COULOMB: tuple[float, ...]": tuple(map(float, arm.frictionloss)),
        "VISCOUS: tuple[float, ...]": tuple(map(float, arm.damping)),
        "EFFECTS: tuple[dict[str, Any], ...]": tuple(effects),
    }
    text = Path(standalone_effects.__file__).read_text(encoding="utf-8")
    head, remainder = text.split("# data\n")
    empty, code = remainder.split("# end of data\n")
    notes = {line.split(" = ")[0]: line.partition("#")[2] for line in empty.splitlines()}
    lines = []
    for name, value in data.items():
        if notes[name]:
            lines.append(f"#{notes[name]}")
        lines.append(f"{name} = {pprint.pformat(value, width=110, sort_dicts=False)}")
    head = head.replace("arm.xml", out)
    return f"{head}# of {source}, beside {out}\n" + "\n".join(lines) + f"\n# end of data\n{code}"


def _entry(correction: Correction, entry: ModelEffect) -> dict[str, Any]:
    """An effect as the file has it."""
    joints = tuple(correction.arm.joint_names.index(name) for name in entry.joints)
    p: dict[str, Any] = {name: float(value) for name, value in entry.parameters.items()}
    if entry.effect in ("joint_elasticity", "backlash"):
        p["damper"] = 2 * p["damping"] * math.sqrt(p["stiffness"] * float(correction.inertia[joints[0]]))
    if entry.effect == "dress_pack" and "low" in p:
        from scipy.interpolate import CubicSpline

        nodes = np.linspace(p["low"], p["high"], N_NODES)
        curve = CubicSpline(nodes, [p[f"torque_{k}"] for k in range(N_NODES)], bc_type="natural")
        p = {
            **{key: p[key] for key in ("travel", "hysteresis") if key in p},
            "nodes": nodes.tolist(),
            "curve": curve.c[::-1].tolist(),
        }
    return {"effect": entry.effect, "joints": joints, "parameters": p}
