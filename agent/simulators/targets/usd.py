"""USD: attributes of every joint for PhysX, Newton and MuJoCo, and a script that sets them.

Angular drive gains and viscous friction of PhysX and Newton are per degree, MuJoCo's per radian.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from math import pi

from agent.simulators.targets.arm_numbers import ArmNumbers, JointNumbers
from agent.simulators.targets.python_text import module_text

_DEGREE = pi / 180


def files(numbers: ArmNumbers, step: float) -> Mapping[str, str]:
    """`usd_attributes.json`, `apply_usd.py` and the URDF."""
    rows = [row for joint in numbers.joints for row in _rows(joint, step)]
    document = {"schema": "usd-attributes/1", "from": numbers.source, "physics_dt_s": step, "attributes": rows}
    lines = [json.dumps(row, ensure_ascii=False) for row in rows]
    listed = json.dumps({**document, "attributes": []}, indent=1).replace("[]", "[\n  " + ",\n  ".join(lines) + "\n ]")
    code = '''
import json
import sys
from pathlib import Path

from pxr import Sdf, Usd

TYPES = {"float": Sdf.ValueTypeNames.Float, "int": Sdf.ValueTypeNames.Int}


def apply(stage, rows):
    """Set the attributes on every joint prim of that name; returns the names that the stage lacks."""
    prims = {prim.GetName(): prim for prim in stage.Traverse() if prim.GetTypeName().startswith("Physics")}
    for row in rows:
        if row["joint"] in prims:
            prim = prims[row["joint"]]
            if row["schema"]:
                prim.AddAppliedSchema(row["schema"])
            prim.CreateAttribute(row["attribute"], TYPES[row["type"]]).Set(row["value"])
    return sorted({row["joint"] for row in rows} - set(prims))


if __name__ == "__main__":
    stage = Usd.Stage.Open(sys.argv[1])
    rows = json.loads(Path(__file__).with_name("usd_attributes.json").read_text(encoding="utf-8"))["attributes"]
    if missing := apply(stage, rows):
        sys.exit(f"no joint prims called {', '.join(missing)}")
    stage.Save()
'''
    says = "Sets the attributes of usd_attributes.json: python apply_usd.py arm.usd."
    return {
        "usd_attributes.json": listed,
        "apply_usd.py": module_text(numbers, says, {}, code),
        f"{numbers.name}.urdf": numbers.urdf,
    }


def _rows(joint: JointNumbers, step: float) -> Iterator[dict[str, str | float | int]]:
    kind, per, way = ("linear", 1.0, "m") if joint.prismatic else ("angular", _DEGREE, "degree")
    force, inertia = ("N", "kg") if joint.prismatic else ("N·m", "kg·m²")
    axis, drive, schema = f"physxJointAxis:{kind}", f"drive:{kind}:physics", f"PhysxJointAxisAPI:{kind}"

    def row(attribute: str, value: float, unit: str, schema: str = "") -> dict[str, str | float | int]:
        return {
            "joint": joint.name,
            "attribute": attribute,
            "type": "int" if isinstance(value, int) else "float",
            "value": value if isinstance(value, int) else float(f"{value:.9g}"),
            "unit": unit,
            "schema": schema,
        }

    yield row("physxJoint:armature", joint.armature, inertia, "PhysxJointAPI")
    yield row(f"{axis}:staticFrictionEffort", joint.frictionloss, force, schema)
    yield row(f"{axis}:dynamicFrictionEffort", joint.frictionloss, force)
    yield row(f"{axis}:viscousFrictionCoefficient", joint.damping * per, f"{force}·s/{way}")
    yield row("newton:armature", joint.armature, inertia)
    yield row("newton:friction", joint.frictionloss, force)
    yield row("newton:damping", joint.damping * per, f"{force}·s/{way}")
    yield row("mjc:armature", joint.armature, inertia)
    yield row("mjc:frictionloss", joint.frictionloss, force)
    yield row("mjc:damping", joint.damping, f"{force}·s/{'m' if joint.prismatic else 'rad'}")
    if joint.stiffness:
        yield row("mjc:stiffness", joint.stiffness, f"{force}/{'m' if joint.prismatic else 'rad'}")
        yield row("mjc:springref", joint.rest / per, way)
    if joint.kp is not None and joint.kv is not None:
        yield row(f"{drive}:stiffness", joint.kp * per, f"{force}/{way}", f"PhysicsDriveAPI:{kind}")
        yield row(f"{drive}:damping", joint.kv * per, f"{force}·s/{way}")
        if joint.effort is not None:
            yield row(f"{drive}:maxForce", joint.effort, force)
    if joint.delay > 0:
        yield row(
            "newton:delaySteps", round(joint.delay / step), f"physics steps of {step:.6g} s, on the actuator prim"
        )
