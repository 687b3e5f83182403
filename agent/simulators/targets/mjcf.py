"""MuJoCo 4: one MJCF with bodies, friction, springs and servos. A delay is the actuator's own (nsample, delay)."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from xml.etree.ElementTree import SubElement

import numpy as np

from agent.simulators.targets.arm_numbers import ArmNumbers, JointNumbers
from agent.simulators.urdf import digits


def files(numbers: ArmNumbers, step: float) -> Mapping[str, str]:
    """`<arm>.xml`. Of an arm without known servos the actuators are motors, whose control is the torque."""
    root = ElementTree.fromstring(numbers.mjcf)
    option = root.find("option")
    assert option is not None
    option.attrib.update(timestep=digits(step), integrator="implicitfast")  # kv of a servo is integrated implicitly
    actuator = SubElement(root, "actuator")
    for joint in numbers.joints:
        if joint.kp is None or joint.kv is None:
            element = SubElement(actuator, "motor", name=joint.name, joint=joint.name)
        else:
            element = SubElement(
                actuator, "position", name=joint.name, joint=joint.name, kp=digits(joint.kp), kv=digits(joint.kv)
            )
        if joint.effort is not None:
            element.set("forcerange", digits(-joint.effort, joint.effort))
        if joint.delay > 0:
            element.attrib.update(nsample=str(samples(joint, step)), interp="linear", delay=digits(joint.delay))
    ElementTree.indent(root)
    return {f"{numbers.name}.xml": '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode")}


def samples(joint: JointNumbers, step: float) -> int:
    """Controls that are kept for a delay."""
    return int(np.ceil(joint.delay / step - 1e-9)) + 1
