"""Genesis: a function that gives an entity's joints their numbers, and the URDF. Its actuators have no delay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.simulators.targets.arm_numbers import ArmNumbers
from agent.simulators.targets.python_text import module_text


def files(numbers: ArmNumbers, step: float) -> Mapping[str, str]:
    """`genesis_arm.py` and the URDF."""
    tables: dict[str, tuple[Any, str]] = {
        "ARMATURE": (numbers.table("armature"), "kg·m²"),
        "FRICTIONLOSS": (numbers.table("frictionloss"), "N·m"),
        "DAMPING": (numbers.table("damping"), "N·m·s/rad"),
        "KP": (numbers.table("kp"), "N·m/rad; None: not known"),
        "KV": (numbers.table("kv"), "N·m·s/rad"),
        "EFFORT": (numbers.table("effort"), "N·m; None: no limit"),
    }
    code = """
def apply(entity):
    \"\"\"After scene.build(). A delay is not in Genesis: hold commands back before control_dofs_position.\"\"\"
    names = list(ARMATURE)
    dofs = [entity.get_joint(name).dofs_idx_local[0] for name in names]
    entity.set_dofs_armature([ARMATURE[name] for name in names], dofs)
    entity.set_dofs_frictionloss([FRICTIONLOSS[name] for name in names], dofs)
    entity.set_dofs_damping([DAMPING[name] for name in names], dofs)
    if all(KP[name] is not None for name in names):
        entity.set_dofs_kp([KP[name] for name in names], dofs)
        entity.set_dofs_kv([KV[name] for name in names], dofs)
    if all(EFFORT[name] is not None for name in names):
        most = [EFFORT[name] for name in names]
        entity.set_dofs_force_range([-value for value in most], most, dofs)
"""
    return {
        "genesis_arm.py": module_text(numbers, f"Joint numbers of {numbers.name} for Genesis.", tables, code),
        f"{numbers.name}.urdf": numbers.urdf,
    }
