"""Link inertial parameters that differ from the model's."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import Columns, Effect, FitContext, Joints, Numbers
from agent.model.effects.experiments import POSTURES
from agent.model.effects.simulator_numbers import FileNumbers, SimulatorNumbers
from agent.robot import LINK_PARAMETERS, ParameterLayout


class InertialMismatch(Effect):
    """τ = Y_k a: ten parameters of one link, or those of all links, each within its prior deviation."""

    name = "inertial_mismatch"
    family = "load"
    scope = "arm"
    formula = "Y_k · Δπ_k"
    source = "Atkeson, An, Hollerbach, Int. J. Robotics Research 5 (1986)"
    signature = "residual of weight and inertia on the joints from the base up to one link"
    confused_with = ("payload", "gravity_spring", "encoder_offset", "torque_constant")
    structurally_equivalent = ("encoder_offset", "payload", "base_tilt", "gravity_spring")
    phrase = "a link is heavier or lighter than in the model"
    look_at = "what was bolted to or taken off this link; link data of the robot description"
    units = MappingProxyType(
        {"m": "kg", **dict.fromkeys(LINK_PARAMETERS[1:4], "kg·m"), **dict.fromkeys(LINK_PARAMETERS[4:], "kg·m²")}
    )
    leading = ("m",)
    shapes = ("mass",)
    experiment = POSTURES
    numbers = FileNumbers.LINKS
    nonlinear = ()

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        return [{"link": float(k + 1)} for k in range(context.reference.robot.dof)]

    def names(self, settings: Numbers) -> tuple[str, ...]:
        return tuple(f"{name}{int(settings['link'])}" for name in LINK_PARAMETERS)

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        last = int(settings["link"])
        link = ParameterLayout.of(signals.reference.robot).link(last - 1)
        return {joint: signals.standard[:, joint, link] for joint in range(last)}

    def filtered(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        return signals.remembered(self.name, lambda: _filtered_links(signals))[int(settings["link"])]

    def release(self, motions: Sequence[MotionSignals]) -> None:
        for motion in motions:
            motion.memory.pop(self.name, None)

    def prior_precision(self, context: FitContext, joints: Joints, settings: Numbers) -> np.ndarray | None:
        layout = ParameterLayout.of(context.reference.robot)
        return np.diag(1 / context.reference.prior_std[layout.link(int(settings["link"]) - 1)] ** 2)

    def simulator_numbers(self, values: Numbers, load_link: int) -> SimulatorNumbers:
        return SimulatorNumbers(body=(int(values["link"]) - 1, np.array([values[name] for name in self.names(values)])))


def _filtered_links(signals: MotionSignals) -> dict[int, Columns]:
    """Per link (from 1) the filtered columns of its parameters. All links at once cost one regressor."""
    layout, whole, dof = ParameterLayout.of(signals.reference.robot), signals.regressor(), signals.q.shape[1]
    felt = [(link, joint) for link in range(dof) for joint in range(link + 1)]
    filtered = signals.low_pass(np.hstack([whole[:, joint, layout.link(link)] for link, joint in felt]))
    columns: dict[int, Columns] = {link + 1: {} for link in range(dof)}
    for (link, joint), part in zip(felt, np.split(filtered, len(felt), axis=1), strict=True):
        columns[link + 1][joint] = part
    return columns
