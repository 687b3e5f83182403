"""Newton: a function that gives a ModelBuilder's joints their numbers and servos, and the URDF."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.simulators.targets.arm_numbers import ArmNumbers
from agent.simulators.targets.python_text import module_text


def files(numbers: ArmNumbers, step: float) -> Mapping[str, str]:
    """`newton_arm.py` and the URDF."""
    tables: dict[str, tuple[Any, str]] = {
        "PHYSICS_DT": (step, "s, at which actuators step: the delay is counted in it"),
        "ARMATURE": (numbers.table("armature"), "kg·m²"),
        "FRICTION": (numbers.table("frictionloss"), "N·m"),
        "DAMPING": (numbers.table("damping"), "N·m·s/rad"),
        "KP": (numbers.table("kp"), "N·m/rad; None: not known"),
        "KD": (numbers.table("kv"), "N·m·s/rad"),
        "EFFORT": (numbers.table("effort"), "N·m; None: no limit"),
        "DELAY": (numbers.table("delay"), "s, from the command to the servo"),
    }
    code = f'''
import newton
from newton.actuators import ClampingMaxEffort, DrivePD


def build():
    """A ModelBuilder with the arm of {numbers.name}.urdf next to this file."""
    from pathlib import Path

    builder = newton.ModelBuilder()
    builder.add_urdf(str(Path(__file__).with_name("{numbers.name}.urdf")))
    apply(builder)
    return builder


def apply(builder):
    """Joints are found by the last part of their label. A known servo becomes an explicit actuator."""
    for number, label in enumerate(builder.joint_label):
        name = label.rsplit("/", 1)[-1]
        if name not in ARMATURE:
            continue
        dof = builder.joint_qd_start[number]
        builder.joint_armature[dof] = ARMATURE[name]
        builder.joint_friction[dof] = FRICTION[name]
        builder.joint_damping[dof] = DAMPING[name]
        if KP[name] is not None:
            clamping = [] if EFFORT[name] is None else [(ClampingMaxEffort, {{"max_effort": EFFORT[name]}})]
            steps = round(DELAY[name] / PHYSICS_DT) or None
            coordinate = builder.joint_q_start[number]
            builder.add_actuator(
                DrivePD, dof, clamping=clamping, delay_steps=steps, pos_index=coordinate, kp=KP[name], kd=KD[name]
            )
'''
    return {
        "newton_arm.py": module_text(numbers, f"Joint numbers of {numbers.name} for Newton.", tables, code),
        f"{numbers.name}.urdf": numbers.urdf,
    }
