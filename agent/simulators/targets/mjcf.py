"""MuJoCo 4: one MJCF with bodies, friction, springs, servos, and effects as far as passive forces say them.

A delay is the actuator's own (nsample, delay). Springs and damping are polynomials of the joint. Bristles, and what is
periodic in the angle, are `dcmotor` elements without input or current, of which lugre or cogging alone acts.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.polynomial import Polynomial

from agent.model import Bristles, PassiveForces
from agent.simulators.targets.arm_numbers import ArmNumbers, JointNumbers
from agent.simulators.urdf import digits


def files(numbers: ArmNumbers, step: float) -> Mapping[str, str]:
    """`<arm>.xml`. Of an arm without known servos the actuators are motors, whose control is the torque."""
    root = ElementTree.fromstring(numbers.mjcf)
    option = root.find("option")
    assert option is not None
    # without a file's own, the one that integrates kv of a servo implicitly
    option.attrib.update(timestep=digits(step), integrator=numbers.integrator or "implicitfast")
    elements = {element.get("name"): element for element in root.iter("joint")}
    actuator = SubElement(root, "actuator")
    passive: list[Element] = []
    for joint in numbers.joints:
        if joint.kp is None or joint.kv is None:
            element = SubElement(actuator, "motor", name=joint.name, joint=joint.name)
        else:
            element = SubElement(actuator, "position", name=joint.name, joint=joint.name)
            if joint.offset:  # the general one has a bias
                element.tag, bias = "general", (joint.kp * joint.offset, -joint.kp, -joint.kv)
                element.attrib.update(biastype="affine", gainprm=digits(joint.kp), biasprm=digits(*bias))
            else:
                element.attrib.update(kp=digits(joint.kp), kv=digits(joint.kv))
        if joint.effort is not None:
            element.set("forcerange", digits(*(joint.force or (-joint.effort, joint.effort))))
        if joint.asked is not None:
            element.set("ctrlrange", digits(*joint.asked))
        if joint.delay > 0:
            delay = {"nsample": str(samples(joint, step)), "interp": joint.interpolation, "delay": digits(joint.delay)}
            element.attrib.update(delay)
        elements[joint.name].attrib.update(joint.solver)
        forces = [entry.forces for entry in numbers.left if entry.forces and entry.joints == (joint.name,)]
        passive += _passive(elements[joint.name], joint, forces, step)
    actuator.extend(passive)  # behind the servos, which keep their numbers
    ElementTree.indent(root)
    return {f"{numbers.name}.xml": '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode")}


def samples(joint: JointNumbers, step: float) -> int:
    """Controls that are kept for a delay."""
    return int(np.ceil(joint.delay / step - 1e-9)) + 1


def _passive(element: Element, joint: JointNumbers, forces: Sequence[PassiveForces], step: float) -> Iterator[Element]:
    """Put polynomials of springs and damping into a joint; the elements of its bristles and periodic forces."""
    spring = sum((Polynomial(each.spring) for each in forces), Polynomial([0.0]))
    if np.any(spring.coef):
        spring += joint.stiffness * Polynomial([-joint.rest, 1.0])
        middle = 0.5 * (joint.lower + joint.upper) if np.isfinite([joint.lower, joint.upper]).all() else 0.0
        roots = spring.roots()
        rests = roots[np.abs(roots.imag) <= 1e-9 * np.abs(roots)].real
        spring_rest = float(rests[np.argmin(np.abs(rests - middle))]) if len(rests) else middle
        constant, *stiffness = np.append(spring(Polynomial([spring_rest, 1.0])).coef, np.zeros(4))[:4]
        element.attrib.update(stiffness=digits(*stiffness), springref=digits(spring_rest))
        if not len(rests):
            yield _without_current(joint, "constant", cogging=digits(-constant, 0.0, np.pi / 2))
    damping = np.sum([each.damping for each in forces], axis=0)
    if np.any(damping):
        element.set("damping", digits(*(damping + [joint.damping, 0.0, 0.0])))
    for k, (amplitude, order, phase) in enumerate(part for each in forces for part in each.periodic):
        # the angle of a motor that turns `order` times as fast, whose torque acts as many times as strongly
        yield _without_current(
            joint, f"cogging_{k}", gear=digits(order), cogging=digits(-amplitude / order, 1.0, phase)
        )
    bristles = [each.bristles for each in forces if each.bristles is not None]
    for k, each in enumerate(bristle for bristle in bristles if bristle.additional):
        yield _without_current(joint, f"bristles_{k}", lugre=_lugre(each, joint, step))
    if own := [each for each in bristles if not each.additional]:
        speed = next((each.speed for each in own if each.rise), 1.0)
        levels, rises = ([getattr(each, key) for each in own] for key in ("level", "rise"))
        whole = Bristles(sum(levels), sum(rises), speed, max(each.travel for each in own)).of_joint(joint.frictionloss)
        element.set("frictionloss", digits(joint.frictionloss - whole.level))
        yield _without_current(joint, "friction", lugre=_lugre(whole, joint, step))


def _lugre(bristles: Bristles, joint: JointNumbers, step: float) -> str:
    """Numbers of lugre: stiffness, damping, Coulomb and static level, Stribeck's speed.

    The step limits the stiffness σ, as the force is explicit: step √(σ / inertia) ≤ 1.
    """
    static = bristles.level + bristles.rise
    highest = joint.inertia / step**2
    stiffness = min(static / bristles.travel, highest) if bristles.travel else highest
    return digits(stiffness, 0.0, bristles.level, static, bristles.speed)


def _without_current(joint: JointNumbers, name: str, **passive: str) -> Element:
    attributes = {"name": f"{joint.name}_{name}", "joint": joint.name, "input": "none", "motorconst": "0"}
    return Element("dcmotor", {**attributes, "resistance": "1", **passive})
