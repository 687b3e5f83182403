"""Every effect as several laws: what each changes of a machine, and of which kinds no catalogue has a form.

A law is a function of the machine, the first of its joints, an `amount` and a generator for its shape. The generator is
always a fresh one, so that only the amount differs between two tries. `second_world.sizing` finds the amount at which
the torque changes by the size that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from second_world.kernel import Kind
from second_world.machine import AddedBody, DrawnMachine, Push

Build = Callable[[DrawnMachine, int, float, np.random.Generator], None]


@dataclass(frozen=True)
class WorldLaw:
    """`highest` amount that makes sense, `first` that is tried; `reserved` ones are drawn for judgement alone.

    `where`: on a `joint`, `lifting` (not on the first, whose torque no gravity changes), `wrist` (the last two), `arm`.
    """

    effect: str
    name: str
    build: Build
    where: str
    first: float
    highest: float
    reserved: bool


#: effect -> its laws by name
LAWS: dict[str, dict[str, WorldLaw]] = {}
#: Effects that no catalogue has a form for.
OUTSIDE: dict[str, dict[str, WorldLaw]] = {}


def law(
    effect: str,
    name: str,
    where: str = "joint",
    first: float = 0.03,
    highest: float = 1.0,
    reserved: bool = False,
    catalogue: dict[str, dict[str, WorldLaw]] = LAWS,
) -> Callable[[Build], Build]:
    """Decorator: enters a law."""

    def enter(build: Build) -> Build:
        catalogue.setdefault(effect, {})[name] = WorldLaw(effect, name, build, where, first, highest, reserved)
        return build

    return enter


#: Decorator: enters a law of an effect that no catalogue has.
outside = partial(law, catalogue=OUTSIDE)

#: A number of a term: fixed, or drawn for a machine and a joint.
Number = float | Callable[[DrawnMachine, int, np.random.Generator], float]


def _drawn(numbers: tuple[Number, ...], m: DrawnMachine, k: int, rng: np.random.Generator) -> list[float]:
    return [number(m, k, rng) if callable(number) else number for number in numbers]


def between(low: float, high: float) -> Number:
    """Drawn from a range."""
    return lambda m, k, rng: rng.uniform(low, high)


def of_speed(low: float, high: float) -> Number:
    """Drawn from a range, times the joint's largest speed."""
    return lambda m, k, rng: _speed(m, k) * rng.uniform(low, high)


def among(*values: float) -> Number:
    """One of some values."""
    return lambda m, k, rng: float(rng.choice(values))


def _term(kind: Kind, numbers: tuple[Number, ...], signed: bool = False) -> Build:
    """A law that is one term on its joint, `amount` of the nominal torque large, of either sign where `signed`."""

    def build(machine: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        sign = float(rng.choice([-1.0, 1.0])) if signed else 1.0
        size = sign * amount * float(machine.world.arm.torque[k])
        machine.add(kind, k, size, *_drawn(numbers, machine, k, rng))

    return build


def _enter(effect: str, name: str, kind: Kind, *numbers: Number, signed: bool = False, **more: Any) -> None:
    """Enters a law that is one term; `more` as of `law`."""
    law(effect, name, **more)(_term(kind, numbers, signed))


def _speed(m: DrawnMachine, k: int, rng: np.random.Generator | None = None) -> float:
    return float(m.world.arm.speed[k])


def _nominal(m: DrawnMachine, k: int, rng: np.random.Generator | None = None) -> float:
    return float(m.world.arm.torque[k])


def _order(m: DrawnMachine, k: int, rng: np.random.Generator) -> float:
    """Periods a radian of the joint times 2 π: of the motor, or of a part of the gear."""
    return float(m.world.arm.kind.ratio * rng.choice([0.1, 0.25, 0.5, 1.0, 2.0]))


def _heating(m: DrawnMachine, k: int, rng: np.random.Generator) -> float:
    """Warming by the usual friction at full speed."""
    return rng.uniform(0.3, 1.5) / float(m.friction[k, 1] * _speed(m, k))


# Friction.
_enter("stribeck", "exponential", Kind.FADING, of_speed(0.01, 0.06), among(0.5, 1, 2))
_enter("stribeck", "hyperbolic", Kind.HYPERBOLIC, of_speed(0.01, 0.05))
_enter("stribeck", "gaussian", Kind.FADING, of_speed(0.02, 0.08), 2.0)
_enter("stribeck", "remembered", Kind.REMEMBERED, of_speed(0.01, 0.05), between(0.02, 0.1), reserved=True)
_enter("asymmetric_friction", "level", Kind.ONE_WAY, signed=True)
_enter("asymmetric_friction", "rising", Kind.ONE_WAY_RISING, of_speed(0.05, 0.3), signed=True)
_enter("asymmetric_friction", "viscous", Kind.ONE_WAY_VISCOUS, _speed, among(-1.0, 1.0))
_enter("load_dependent_friction", "proportional", Kind.LOADED, _nominal)
_enter("load_dependent_friction", "power", Kind.LOADED_POWER, _nominal, between(0.6, 1.6))
_enter("load_dependent_friction", "driving", Kind.DRIVING, _nominal)
_enter("load_dependent_friction", "overload", Kind.OVERLOADED, _nominal, between(0.1, 0.3), reserved=True)
_enter("viscous_nonlinearity", "shear_thinning", Kind.ASINH, of_speed(0.03, 0.15))
_enter("viscous_nonlinearity", "cross", Kind.THINNING, of_speed(0.05, 0.2), between(0.3, 0.6))
_enter("viscous_nonlinearity", "churning", Kind.CHURNING, _speed, highest=5.0)
_enter("viscous_nonlinearity", "root", Kind.ROOT, of_speed(0.1, 0.3), reserved=True)


@law("thermal_friction", "cold_start")
def _cold_start(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    after = rng.uniform(15, 60)
    m.add(Kind.COLD_TIME, k, amount * _nominal(m, k), after)
    m.add(Kind.COLD_VISCOUS, k, amount * _nominal(m, k), _speed(m, k), after)


_enter("thermal_friction", "worked_in", Kind.COLD_DISTANCE, between(3, 15))
_enter("thermal_friction", "dissipated", Kind.COLD_POWER, _heating, between(40, 200))
_enter("thermal_friction", "dry_start", Kind.DRY, between(0.3, 1.5), between(5, 30), reserved=True)


def _presliding(kind: Kind, second: bool = False) -> Build:
    """A share of the level builds up over `amount` [rad] more than usual after a reversal; sliding is as it was."""

    def build(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        share = rng.uniform(0.5, 0.9)
        part, usual = share * m.friction[k, 1], m.friction[k, 1] / m.friction[k, 5]
        m.add(Kind.CONSTANT, k, -part)
        m.add(kind, k, part, usual + amount, *([usual + amount * rng.uniform(0.3, 0.6)] if second else []))

    return build


law("presliding", "dahl", first=0.02, highest=0.6)(_presliding(Kind.DAHL))
law("presliding", "iwan", first=0.02, highest=0.6)(_presliding(Kind.IWAN))
law("presliding", "bouc_wen", first=0.02, highest=0.6)(_presliding(Kind.BOUC_WEN))
law("presliding", "lopsided", first=0.02, highest=0.6, reserved=True)(_presliding(Kind.LOPSIDED_DAHL, second=True))


@law("friction_change", "coulomb")
def _coulomb(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    change = amount * _nominal(m, k) / m.friction[k, 1]
    m.friction[k, 1:3] *= 1 + change if rng.random() < 0.6 else max(1 - change, 0.2)


@law("friction_change", "viscous", highest=3.0)
def _viscous(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    m.friction[k, 4] += amount * _nominal(m, k) / _speed(m, k)


@law("friction_change", "both")
def _both(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    m.friction[k, 1:3] *= 1 + amount * _nominal(m, k) / m.friction[k, 1]
    m.friction[k, 4] += rng.uniform(0.5, 2.0) * amount * _nominal(m, k) / _speed(m, k)


# Transmission.
def _reduced(m: DrawnMachine, k: int) -> float:
    """[kg·m²] of the rotor swinging against the arm."""
    rotor = float(m.world.arm.rotor[k])
    link = max(float(m.effective_inertia[k]) - rotor, 0.02 * rotor)
    return rotor * link / (rotor + link)


def _soft(kind: int, shape: Callable[[np.random.Generator], float] = lambda r: 1.0) -> Build:
    """A gear that is `amount` times as soft as one that swings at 20 Hz, never stiffer than one at 70 Hz."""

    def build(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        inertia = _reduced(m, k)
        stiffness = inertia * (2 * np.pi) ** 2 * min(400.0 / amount, 4900.0)
        damping = 2 * rng.uniform(0.03, 0.12) * np.sqrt(stiffness * inertia)
        m.gears[k] = kind, stiffness, damping, 0.0, shape(rng) * (_nominal(m, k) / stiffness if kind in (2, 4) else 1.0)

    return build


def _play(kind: int) -> Build:
    """Teeth with a play of `amount` [rad]."""

    def build(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        inertia = _reduced(m, k)
        stiffness = inertia * (2 * np.pi * rng.uniform(90, 130)) ** 2
        damping = 2 * rng.uniform(0.1, 0.3) * np.sqrt(stiffness * inertia)
        shape = _nominal(m, k) / stiffness if kind == 6 else rng.uniform(0.4, 0.8)
        m.gears[k] = kind, stiffness, damping, amount, shape

    return build


law("joint_elasticity", "linear", first=1.0, highest=20.0)(_soft(1))
law("joint_elasticity", "hardening", first=1.0, highest=20.0)(_soft(2, lambda r: r.uniform(0.5, 2)))
law("joint_elasticity", "maxwell", first=1.0, highest=20.0)(_soft(3, lambda r: r.uniform(0.2, 0.6)))
law("joint_elasticity", "softening", first=1.0, highest=10.0, reserved=True)(_soft(4, lambda r: r.uniform(3, 6)))
law("backlash", "dead_zone", first=0.01, highest=0.2)(_play(5))
law("backlash", "hertz", first=0.01, highest=0.2)(_play(6))
law("backlash", "round", first=0.01, highest=0.2)(_play(8))
outside("lopsided_backlash", "hysteretic", first=0.01, highest=0.2)(_play(7))

_enter("torque_ripple", "two_harmonics", Kind.SINE, _order, between(0, 6), between(0, 0.6))
_enter("torque_ripple", "triangle", Kind.TRIANGLE, _order, between(0, 6))
_enter("torque_ripple", "with_current", Kind.CURRENT_SINE, _order, between(0, 6), _nominal, highest=5.0)
_enter("torque_ripple", "teeth", Kind.TEETH, _order, between(0, 6))
_enter("torque_ripple", "beating", Kind.BEATING, _order, between(0, 6), between(1.05, 1.3), reserved=True)


def _ratio(rng: np.random.Generator) -> float:
    return float(rng.choice([-1, 1]) * rng.uniform(0.4, 1.6))


@law("wrist_coupling", "drag", "wrist")
def _drag(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    first, second = k, k + 1
    size, ratio = amount * _nominal(m, second), _ratio(rng)
    m.pairs.append([first, second, ratio, size, rng.uniform(0, 1) * size / _speed(m, second)])


@law("wrist_coupling", "oil", "wrist", highest=3.0)
def _oil(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    first, second = k, k + 1
    m.pairs.append([first, second, _ratio(rng), 0.0, amount * _nominal(m, second) / _speed(m, second)])


@law("wrist_coupling", "shaft", "wrist", highest=3.0)
def _shaft(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    first, second = k, k + 1
    ratio = _ratio(rng)
    m.wrist_inertia = first, second, ratio, amount * float(m.world.arm.rotor[second])
    m.pairs.append([first, second, ratio, 0.3 * amount * _nominal(m, second), 0.0])


# Bodies and what acts on them.
def _hanging(m: DrawnMachine, k: int) -> float:
    """Mass [kg] that loads the shoulder with its nominal torque from a metre away."""
    return float(m.world.arm.torque[1]) / 9.81


def _direction(rng: np.random.Generator) -> np.ndarray:
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def _tool(shape: str) -> Build:
    def build(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        mass, last = amount * _hanging(m, 0), m.world.arm.n - 1
        reach = float(np.abs(m.world.arm.origin).sum())
        centre = reach * np.array([rng.uniform(-0.04, 0.04), rng.uniform(-0.04, 0.04), rng.uniform(0.0, 0.1)])
        radius = reach * {"point": 0.005, "ball": 0.05}.get(shape, 0.02)
        m.bodies.append(AddedBody(last, mass, centre, np.full(3, 0.4 * mass * radius**2)))
        if shape == "pair":
            offset = reach * rng.uniform(0.05, 0.15) * _direction(rng)
            m.bodies.append(AddedBody(last, 0.5 * mass, centre + offset, np.full(3, 0.2 * mass * radius**2)))
        if shape == "rod":
            length = reach * rng.uniform(0.1, 0.25)
            m.bodies.append(AddedBody(last, 0.2 * mass, centre, mass * length**2 / 12 * np.array([1.0, 1.0, 0.05])))

    return build


for _shape, _reserved in (("point", False), ("ball", False), ("rod", False), ("pair", True)):
    law("payload", _shape, "arm", first=0.03, highest=0.5, reserved=_reserved)(_tool(_shape))


@law("inertial_mismatch", "denser", "arm", highest=3.0)
def _denser(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    link, change = int(rng.integers(1, m.world.arm.n - 1)), amount * float(rng.choice([-1, 1]))
    m.mass[link] *= max(1 + 2 * change, 0.3)
    m.inertia[link] *= max(1 + 2 * change, 0.3)


@law("inertial_mismatch", "bolted_on", "arm", highest=1.0)
def _bolted_on(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    link, mass = int(rng.integers(1, m.world.arm.n - 1)), amount * _hanging(m, 0)
    reach = float(np.abs(m.world.arm.origin).sum())
    m.bodies.append(AddedBody(link, mass, 0.15 * reach * _direction(rng), np.full(3, 1e-3 * mass * reach**2)))


@law("inertial_mismatch", "shifted", "arm", highest=1.0)
def _shifted(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    link = int(rng.integers(1, m.world.arm.n - 1))
    m.centre[link] += amount * float(np.abs(m.world.arm.origin).sum()) * _direction(rng)


def _leaning(how: str) -> Build:
    def build(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        heading = rng.uniform(0, 2 * np.pi) if how == "wedge" else rng.integers(4) * np.pi / 2
        after = rng.uniform(10, 40)

        def down(t: float) -> np.ndarray:
            lean = amount * (1 - np.exp(-t / after) if how == "settling" else 1.0)
            return np.array([np.sin(lean) * np.cos(heading), np.sin(lean) * np.sin(heading), -np.cos(lean)])

        m.gravity = down

    return build


law("base_tilt", "wedge", "arm", highest=0.5)(_leaning("wedge"))
law("base_tilt", "one_foot", "arm", highest=0.5)(_leaning("one_foot"))
law("base_tilt", "settling", "arm", highest=0.5)(_leaning("settling"))


def _pushing(how: str) -> Build:
    """A force of `amount` nominal shoulder torques over a metre, on a link, over a stretch of every motion."""

    def build(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        link, direction = int(rng.integers(2, m.world.arm.n)), _direction(rng)
        size, start, duration = amount * _hanging(m, 0) * 9.81, rng.uniform(0.05, 0.6), rng.uniform(0.08, 0.3)
        began: dict[int, np.ndarray] = {}

        def force(share: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
            x = (share - start) / duration
            if not 0 < x < 1:
                began.clear()
                return np.zeros(3)
            swell = np.sin(np.pi * min(1.0, 8 * min(x, 1 - x)) / 2) ** 2
            if how == "wall":  # pushes back along `direction` the further the link goes the other way
                depth = max(float((began.setdefault(0, position.copy()) - position) @ direction), 0.0)
                return size * direction * swell * (0.2 + 5 * depth)
            if how == "rubbing":
                return -size * swell * velocity / (np.linalg.norm(velocity) + 0.02)
            if how == "knocks":
                return size * direction * swell * (np.sin(24 * np.pi * x) > 0.6)
            return size * direction * swell

        m.pushes.append(Push(link, force))

    return build


for _how, _reserved in (("leaning", False), ("wall", False), ("rubbing", False), ("knocks", True)):
    law("contact", _how, "arm", first=0.1, highest=3.0, reserved=_reserved)(_pushing(_how))

_enter("gravity_spring", "torsion", Kind.TORSION, between(-0.6, 0.6), signed=True)
_enter("gravity_spring", "pivots", Kind.PIVOTS, between(-0.6, 0.6), between(0.2, 0.5), signed=True)
_enter("gravity_spring", "cylinder", Kind.CYLINDER, between(-0.6, 0.6), between(0.2, 0.6), signed=True)
_enter("gravity_spring", "cam", Kind.CAM, between(-0.6, 0.6), between(0.3, 0.8), signed=True, reserved=True)


def _rubbing_hose(kind: Kind, *numbers: Number) -> Build:
    def build(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        m.add(kind, k, amount * _nominal(m, k), *_drawn(numbers, m, k, rng))
        m.add(Kind.DAHL, k, rng.uniform(0.05, 0.2) * amount * _nominal(m, k), rng.uniform(0.02, 0.1))

    return build


law("dress_pack", "slack")(_rubbing_hose(Kind.SLACK, between(-0.5, 0.5), between(0, 0.4)))
law("dress_pack", "one_sided")(_rubbing_hose(Kind.ONE_SIDED, between(-0.4, 0.4), between(0.05, 0.2), among(-1.0, 1.0)))
_enter("dress_pack", "hysteretic", Kind.HOSE, between(0.05, 0.2), between(0.5, 1.5), between(-0.5, 0.5))
_enter("dress_pack", "relaxing", Kind.RELAXING, between(-0.4, 0.4), between(0.4, 1), between(3, 15), reserved=True)


# Measurement.
def _reads(m: DrawnMachine, k: int, reading: Callable[[np.ndarray, float], np.ndarray]) -> None:
    """The torque of joint k is reported as `reading` has it: (S,) torques of a motion that began at t [s] → (S,)."""

    def report(signals: np.ndarray, began: float) -> np.ndarray:
        signals[2, :, k] = reading(signals[2, :, k], began)
        return signals

    m.reports.append(report)


@law("torque_constant", "sensor")
def _sensor(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    scale = 1 + amount * float(rng.choice([-1, 1]))
    _reads(m, k, lambda torque, _: torque * scale)


@law("torque_constant", "magnets", highest=0.7)
def _magnets(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    m.servo[k, 8] = 1 + amount if rng.random() < 0.3 else 1 - amount


@law("torque_constant", "saturating", highest=3.0)
def _saturating(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    knee = rng.uniform(0.7, 2.0) * _nominal(m, k)
    _reads(m, k, lambda current, _: current * (1 + amount / np.sqrt(1 + (current / knee) ** 2)))


@law("torque_offset", "sensor")
def _shift(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    _reads(m, k, lambda torque, _: torque + amount)


@law("torque_offset", "in_the_loop")
def _in_the_loop(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    m.servo[k, 9] -= amount


@law("torque_offset", "wandering")
def _wandering(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    slow, phase = rng.uniform(60, 200), rng.uniform(0, 6)

    def reading(torque: np.ndarray, began: float) -> np.ndarray:
        t = began + np.arange(len(torque)) / 1000.0
        return torque + amount * (1 + 0.15 * np.sin(2 * np.pi * t / slow + phase))

    _reads(m, k, reading)


def _late(how: str) -> Build:
    """Torques that are `amount` [s] late, by a shift, a filter or a mean, or early, as where positions are late."""

    def build(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        samples = 1000.0 * amount

        def delayed(values: np.ndarray) -> np.ndarray:
            at = np.arange(len(values), dtype=float)
            if how in ("late", "early"):
                return np.interp(at - (samples if how == "late" else -samples), at, values)
            memory = np.exp(-np.arange(max(int(12 * samples), 2)) / max(samples, 1e-3))
            whole = int(2 * samples)
            weights = memory if how == "filtered" else np.append(np.ones(whole + 1), 2 * samples - whole)
            padded = np.concatenate([np.full(len(weights) - 1, values[0]), values])
            return np.convolve(padded, weights / weights.sum(), mode="valid")

        def report(signals: np.ndarray, began: float) -> np.ndarray:
            signals[2] = np.apply_along_axis(delayed, 0, signals[2])
            return signals

        m.reports.append(report)

    return build


for _how, _reserved in (("late", False), ("early", False), ("filtered", False), ("averaged", True)):
    law("time_delay", _how, "arm", first=0.005, highest=0.1, reserved=_reserved)(_late(_how))


@law("encoder_offset", "mounted", "lifting", highest=0.5)
def _mounted(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    m.servo[k, 7] += amount * float(rng.choice([-1, 1]))


@law("encoder_offset", "eccentric", "lifting", highest=0.5)
def _eccentric(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    """The offset, and a scale that is off centre by a fifth of it."""
    sign, phase = float(rng.choice([-1, 1])), rng.uniform(0, 6)
    m.servo[k, 7] += amount * sign

    def report(signals: np.ndarray, began: float) -> np.ndarray:
        signals[0, :, k] += 0.2 * amount * sign * np.sin(signals[0, :, k] + phase)
        return signals

    m.reports.append(report)


@law("encoder_offset", "belt", "lifting", highest=0.5)
def _belt(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    """The offset, and a belt in front of the encoder that stretches with the torque by up to a tenth of it."""
    sign = float(rng.choice([-1, 1]))
    m.servo[k, 7] += amount * sign

    def report(signals: np.ndarray, began: float) -> np.ndarray:
        signals[0, :, k] += 0.1 * amount * np.tanh(signals[2, :, k] / _nominal(m, k))
        return signals

    m.reports.append(report)


def _other_path(how: str) -> Build:
    """Set-points that are not the planned ones, by about `amount` of the speed: faster or slower, corners rounded, or
    late by joint. They take as long as the plan, so that the duration of a log tells nothing."""

    def build(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
        rate = 1 + amount * float(rng.choice([-1, 1]))
        lags = rng.uniform(0.3, 1.5, m.world.arm.n)

        def path(points: np.ndarray) -> np.ndarray:
            at = np.arange(len(points), dtype=float)
            if how == "faster":
                index = np.minimum(at * rate, len(points) - 1)
                return np.stack([np.interp(index, at, column) for column in points.T], axis=1)
            if how == "late":
                return np.stack(
                    [np.interp(at - 1e3 * amount * lag, at, c) for lag, c in zip(lags, points.T, strict=True)], axis=1
                )
            width = max(2 * int(1e3 * amount) + 1, 3)
            padded = np.pad(points, ((width // 2, width // 2), (0, 0)), mode="edge")
            return np.stack([np.convolve(c, np.ones(width) / width, mode="valid") for c in padded.T], axis=1)

        m.path = path

    return build


law("interpolator_mismatch", "faster", "arm", first=0.02, highest=0.3)(_other_path("faster"))
law("interpolator_mismatch", "rounded", "arm", first=0.02, highest=0.3)(_other_path("rounded"))
law("interpolator_mismatch", "late", "arm", first=0.02, highest=0.3)(_other_path("late"))


# What no catalogue has.
@outside("flexible_base", "rocking", "arm", first=0.03, highest=1.0)
def _flexible_base(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    stiffness = float(m.world.arm.torque[1]) / (0.02 * amount)
    damping = 0.05 * stiffness / (2 * np.pi * rng.uniform(6, 12))
    m.base = stiffness, damping


_enter(
    "sticking_valve",
    "stick_slip",
    Kind.VALVE,
    between(-0.6, 0.6),
    between(0.2, 0.5),
    signed=True,
    where="lifting",
    catalogue=OUTSIDE,
)
_enter("tendon_creep", "creep", Kind.CREEP, 0.0, between(1.0, 5.0), catalogue=OUTSIDE)
_enter("loose_tool", "between_stops", Kind.LOOSE, between(-1, 1), between(0.005, 0.03), catalogue=OUTSIDE)
_enter("shaking_floor", "sine", Kind.VIBRATION, between(2, 12), between(0, 6), catalogue=OUTSIDE)
_enter("brake_steps", "by_turns", Kind.STEPS, between(0.3, 1.2), between(0, 99), catalogue=OUTSIDE)
_enter("rough_bearing", "patches", Kind.ROUGH, between(0.05, 0.15), between(0, 99), catalogue=OUTSIDE)
_enter(
    "sloshing",
    "pendulum",
    Kind.SLOSH,
    between(6, 18),
    between(0.02, 0.1),
    catalogue=OUTSIDE,
    reserved=True,
    highest=5.0,
)


@outside("crosstalk", "linear")
def _crosstalk(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    n = m.world.arm.n
    other = (k + 1 + int(rng.integers(n - 1))) % n
    share = float(rng.choice([-1, 1])) * amount * _nominal(m, k) / _nominal(m, other)

    def report(signals: np.ndarray, began: float) -> np.ndarray:
        signals[2, :, k] += share * signals[2, :, other]
        return signals

    m.reports.append(report)


@outside("warm_magnets", "heated_by_current", highest=3.0)
def _warm_magnets(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    after = rng.uniform(8, 30)
    now = 0.0

    def reading(torque: np.ndarray, began: float) -> np.ndarray:
        nonlocal now
        warm = np.empty(len(torque))
        for i, power in enumerate((torque / _nominal(m, k)) ** 2):
            now += (power - now) * 1e-3 / after
            warm[i] = now
        return torque * (1 + amount * (warm / 0.3))

    _reads(m, k, reading)


@outside("tool_drag", "square", "arm", first=0.1, highest=50.0)
def _tool_drag(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    """A broad tool in air or in a liquid: −c |v| v, stronger across a direction of the base frame."""
    size, direction = amount * _hanging(m, 0) * 9.81, _direction(rng)

    def force(share: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return -size * np.linalg.norm(velocity) * (velocity - 0.5 * direction * (direction @ velocity))

    m.pushes.append(Push(m.world.arm.n - 1, force))


@outside("holding_sensor", "now_and_then", first=0.05, highest=1.5, reserved=True)
def _holding(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    starts = np.cumsum(rng.exponential(1500.0, 200)).astype(int)
    lengths = rng.exponential(1.0, 200)

    def reading(torque: np.ndarray, began: float) -> np.ndarray:
        for start, length in zip(starts, lengths, strict=True):
            if start < len(torque):
                torque[start : start + int(1000 * amount * length)] = torque[start]
        return torque

    _reads(m, k, reading)


@outside("clipped_torque", "converter", first=0.05, highest=1.0, reserved=True)
def _clipped(m: DrawnMachine, k: int, amount: float, rng: np.random.Generator) -> None:
    def reading(torque: np.ndarray, began: float) -> np.ndarray:
        limit = (1 - amount) * np.abs(torque).max()
        return np.clip(torque, -limit, limit)

    _reads(m, k, reading)
