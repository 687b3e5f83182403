"""Isaac Lab: actuator configuration by the names of 2.3 and of 3.0, and randomisation events."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agent.simulators.targets.arm_numbers import ArmNumbers
from agent.simulators.targets.python_text import module_text, scaled

_FIELDS = Path(__file__).with_name("isaaclab_fields.json")


def files(numbers: ArmNumbers, step: float) -> Mapping[str, str]:
    """`isaaclab_<version>.py` of each version whose fields are known, `isaaclab_events.py`, and the URDF."""
    versions = json.loads(_FIELDS.read_text(encoding="utf-8"))["versions"]
    texts = {f"isaaclab_{v.replace('.', '_')}.py": _actuators(numbers, step, v, names) for v, names in versions.items()}
    return {**texts, "isaaclab_events.py": _events(numbers), f"{numbers.name}.urdf": numbers.urdf}


def _actuators(numbers: ArmNumbers, step: float, version: str, names: Mapping[str, str]) -> str:
    late = max(joint.delay for joint in numbers.joints)
    tables: dict[str, tuple[Any, str]] = {
        "PHYSICS_DT": (step, "s, your sim.dt, not the control step: the delay is counted in it"),
        "STIFFNESS": (numbers.table("kp"), "kp, N·m/rad; None keeps the USD's"),
        "DAMPING": (
            numbers.table("kv"),
            "kv, N·m·s/rad. Logs of positions fix kv + viscous friction only; split as in the file",
        ),
        "EFFORT": (numbers.table("effort"), "N·m; None keeps the USD's"),
        "VELOCITY": (numbers.table("velocity"), "rad/s; None keeps the USD's"),
        "ARMATURE": (numbers.table("armature"), "kg·m²"),
        "FRICTION": (
            numbers.table("frictionloss"),
            "N·m with Isaac Sim 5 and later; 4.5 takes a coefficient, so leave it out there",
        ),
        "VISCOUS": (numbers.table("damping"), "N·m·s/rad"),
    }
    fields = {
        "joint_names_expr": "joints",
        "stiffness": "_known(of(STIFFNESS))",
        "damping": "_known(of(DAMPING))",
        names["effort"]: "_limits(of(EFFORT))",
        names["velocity"]: "_limits(of(VELOCITY))",
        "armature": "of(ARMATURE)",
        "friction": "of(FRICTION)",
        "dynamic_friction": "of(FRICTION)",
        "viscous_friction": "of(VISCOUS)",
    }
    kind = "ImplicitActuatorCfg"
    if late > 0:
        kind = "DelayedPDActuatorCfg"
        tables["DELAY"] = (
            numbers.table("delay"),
            "s, from the command to the servo. Half a frame of a held command is not in it: the simulator holds it too",
        )
        fields |= {"min_delay": "steps", "max_delay": "steps"}
        fields[names["explicit_effort"]] = "_limits(of(EFFORT))"
    listed = "\n".join(f"        {field}={value}," for field, value in fields.items())
    steps = "round(DELAY[name] / PHYSICS_DT)" if late > 0 else "0"
    code = f"""
from isaaclab.actuators import {kind}


def _known(table):
    return table if all(value is not None for value in table.values()) else None


def _limits(table):
    none = all(value is None for value in table.values())
    return None if none else {{name: 1e9 if value is None else value for name, value in table.items()}}


def _group(joints, steps):
    def of(table):
        return {{name: table[name] for name in joints}}

    return {kind}(
{listed}
    )


# one delay is drawn for a group, so joints of one delay are one group
_STEPS = {{name: {steps} for name in ARMATURE}}
ACTUATORS = {{
    "arm" if len(set(_STEPS.values())) == 1 else f"arm_late_by_{{steps}}_steps": _group(
        [name for name in _STEPS if _STEPS[name] == steps], steps
    )
    for steps in sorted(set(_STEPS.values()))
}}
"""
    says = f"Actuators of {numbers.name} for Isaac Lab {version}: ArticulationCfg(actuators=ACTUATORS)."
    return module_text(numbers, says, tables, code)


def _events(numbers: ArmNumbers) -> str:
    """Events that draw from the ranges that logs leave; as factors, because one draw goes to all three frictions."""
    rows: dict[str, dict[str, tuple[float, float]]] = {}
    masses = {}
    keys = {"frictionloss": "friction_distribution_params", "armature": "armature_distribution_params"}
    for number in numbers.ranges:
        factors = scaled(number.value, number.low, number.high)
        kind, _, owner = number.of.partition(" ")
        if factors and kind == "joint" and number.parameter in keys:
            rows.setdefault(owner, {})[keys[number.parameter]] = factors
        elif factors and number.parameter == "mass" and kind in ("body", "link"):
            masses[owner] = factors
    tables: dict[str, tuple[Any, str]] = {
        "JOINTS": (
            rows,
            "factors of the joint's numbers, 90 %; the draw of friction goes to static, dynamic and viscous friction",
        ),
        "MASSES": (masses, "factors of the body's mass, 90 %; links trade mass, so not all ends at once"),
    }
    code = """
import isaaclab.envs.mdp as mdp
from isaaclab.managers import EventTermCfg, SceneEntityCfg

# with operation="abs" one number would become static, dynamic and viscous friction: keep "scale"
EVENTS = {
    **{
        f"joint_{name}": EventTermCfg(
            func=mdp.randomize_joint_parameters,
            mode="reset",
            params={"asset_cfg": SceneEntityCfg("robot", joint_names=[name]), "operation": "scale", **ranges},
        )
        for name, ranges in JOINTS.items()
    },
    **{
        f"mass_{name}": EventTermCfg(
            func=mdp.randomize_rigid_body_mass,
            mode="startup",
            params={
                "asset_cfg": SceneEntityCfg("robot", body_names=[name]),
                "mass_distribution_params": factors,
                "operation": "scale",
                "recompute_inertia": True,
            },
        )
        for name, factors in MASSES.items()
    },
}
"""
    says = f"Randomisation events of {numbers.name} for Isaac Lab. Nothing but the actuator's own range draws a delay."
    return module_text(numbers, says, tables, code)
