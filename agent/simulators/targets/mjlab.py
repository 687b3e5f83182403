"""mjlab: one actuator configuration per joint, randomisation events, and the MJCF of the bodies."""

from __future__ import annotations

from collections.abc import Mapping
from math import log
from typing import Any

from agent.simulators.targets.arm_numbers import ArmNumbers
from agent.simulators.targets.python_text import module_text, scaled

#: Event term of mjlab.envs.mdp.dr and the number that it draws.
_TERMS = {"frictionloss": "dof_frictionloss", "armature": "dof_armature", "damping": "dof_damping"}


def files(numbers: ArmNumbers, step: float) -> Mapping[str, str]:
    """`mjlab_actuators.py`, `mjlab_events.py` and the MJCF without actuators."""
    return {
        "mjlab_actuators.py": _actuators(numbers, step),
        "mjlab_events.py": _events(numbers),
        f"{numbers.name}.xml": numbers.mjcf,
    }


def _actuators(numbers: ArmNumbers, step: float) -> str:
    tables: dict[str, tuple[Any, str]] = {
        "PHYSICS_DT": (step, "s, timestep of the simulation: the delay is counted in it"),
        "STIFFNESS": (numbers.table("kp"), "kp, N·m/rad; None: not known, pass yours to actuators()"),
        "DAMPING": (
            numbers.table("kv"),
            "kv, N·m·s/rad. Logs of positions fix kv + viscous damping only; split as in the file",
        ),
        "EFFORT": (numbers.table("effort"), "N·m; None: no limit"),
        "ARMATURE": (numbers.table("armature"), "kg·m²"),
        "FRICTIONLOSS": (numbers.table("frictionloss"), "N·m"),
        "VISCOUS": (numbers.table("damping"), "N·m·s/rad, of the joint whatever the servo does"),
        "DELAY": (numbers.table("delay"), "s, from the command to the servo"),
    }
    code = """
from mjlab.actuator import BuiltinPositionActuatorCfg


def actuators(stiffness=STIFFNESS, damping=DAMPING):
    \"\"\"For EntityArticulationInfoCfg. A lag is drawn anew every step, so both its ends are equal.\"\"\"
    return tuple(
        BuiltinPositionActuatorCfg(
            target_names_expr=(name,),
            stiffness=stiffness[name],
            damping=damping[name],
            effort_limit=EFFORT[name],
            armature=ARMATURE[name],
            frictionloss=FRICTIONLOSS[name],
            viscous_damping=VISCOUS[name],
            delay_min_lag=round(DELAY[name] / PHYSICS_DT),
            delay_max_lag=round(DELAY[name] / PHYSICS_DT),
        )
        for name in ARMATURE
    )
"""
    return module_text(numbers, f"Actuators of {numbers.name} for mjlab.", tables, code)


def _events(numbers: ArmNumbers) -> str:
    rows = []
    masses = {}
    for number in numbers.ranges:
        kind, _, owner = number.of.partition(" ")
        if kind == "joint" and number.parameter in _TERMS:
            rows.append((_TERMS[number.parameter], owner, (max(number.low, 0.0), number.high)))
        elif number.parameter == "mass" and (factors := scaled(number.value, number.low, number.high)):
            masses[owner] = tuple(0.5 * log(max(factor, 1e-3)) for factor in factors)
    tables: dict[str, tuple[Any, str]] = {
        "JOINTS": (rows, "term of mjlab.envs.mdp.dr, joint, 90 % range in SI"),
        "MASSES": (masses, "half the logarithm of the factor of the body's mass, 90 %: inertia is scaled along"),
    }
    code = """
from mjlab.envs.mdp import dr
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg

EVENTS = {
    **{
        f"{term}_{name}": EventTermCfg(
            func=getattr(dr, term),
            mode="startup",
            params={"asset_cfg": SceneEntityCfg("robot", joint_names=(name,)), "ranges": ranges, "operation": "abs"},
        )
        for term, name, ranges in JOINTS
    },
    **{
        f"mass_{name}": EventTermCfg(
            func=dr.pseudo_inertia,
            mode="startup",
            params={"asset_cfg": SceneEntityCfg("robot", body_names=(name,)), "alpha_range": ranges},
        )
        for name, ranges in MASSES.items()
    },
}
"""
    return module_text(numbers, f"Randomisation events of {numbers.name} for mjlab.", tables, code)
