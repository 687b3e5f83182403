"""The effects of a corrected simulator as a Python file of their own: `standalone_effects` with the data filled in."""

from __future__ import annotations

import pprint
from pathlib import Path
from typing import Any

import numpy as np

from agent.model import CATALOGUE, ModelEffect
from agent.simulators.corrected import standalone_effects
from agent.simulators.corrected.correction import Correction


def effects_text(correction: Correction, source: str, out: str) -> str | None:
    """The file's text; None where the simulator's file says everything."""
    effects = [of_file for entry in correction.effects if (of_file := _entry(correction, entry)) is not None]
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


def _entry(correction: Correction, entry: ModelEffect) -> dict[str, Any] | None:
    """An effect as the file has it; None where the file has no form for it."""
    joints = tuple(correction.arm.joint_names.index(name) for name in entry.joints)
    effect = CATALOGUE[entry.effect]
    parameters = effect.stepped_parameters(entry.parameters, [float(correction.inertia[joint]) for joint in joints])
    if not effect.stepped or parameters is None:
        return None
    return {"effect": entry.effect, "form": effect.stepped, "joints": joints, "parameters": parameters}
