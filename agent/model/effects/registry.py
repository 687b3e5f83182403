"""Effects by name: the built-in ones, and what others install under the entry point group below.

A built-in effect is a class in a module of `agent.model.effects`; nothing else has to name it. An entry point is an
`Effect`, as a class or an object, with the name of its entry. One that cannot be loaded, or that takes a name that is
taken, is reported and left out. `docs/how-to-effect.md` shows one.
"""

from __future__ import annotations

import importlib
import logging
import pkgutil
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points

from agent.model.effects.effect import Effect

GROUP = "calibration_agent.effects"

#: Results list effects, and a seed draws them, in this order; all others follow by name.
_FIRST = (
    "stribeck", "asymmetric_friction", "load_dependent_friction", "viscous_nonlinearity", "thermal_friction",
    "presliding", "friction_change", "joint_elasticity", "backlash", "torque_ripple", "wrist_coupling", "payload",
    "gravity_spring", "dress_pack", "base_tilt", "inertial_mismatch", "contact", "torque_constant", "torque_offset",
    "time_delay", "encoder_offset", "interpolator_mismatch",
)  # fmt: skip
_DESCRIBED_BY = ("name", "family", "formula", "source", "signature", "phrase", "look_at")
_log = logging.getLogger(__name__)


class Catalogue(Mapping[str, Effect]):
    """Effects by name: the built-in ones in the order of results, then those installed, by name."""

    def __init__(self, built_in: Iterable[Effect]):
        first = {name: number for number, name in enumerate(_FIRST)}
        ordered = sorted(built_in, key=lambda effect: (first.get(effect.name, len(first)), effect.name))
        self._built_in = {effect.name: effect for effect in ordered}

    @property
    def built_in(self) -> tuple[Effect, ...]:
        """Those that need no installation."""
        return tuple(self._built_in.values())

    def __getitem__(self, name: str) -> Effect:
        return self._all[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    def reload(self) -> None:
        """Look again for what is installed; without it that happens once, at the first question."""
        self.__dict__.pop("_all", None)

    @cached_property
    def _all(self) -> dict[str, Effect]:
        effects = dict(self._built_in)
        for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
            if point.name in effects:
                _log.warning("effect %r (%s) is left out: the name is taken", point.name, point.value)
            elif (effect := _load(point)) is not None:
                effects[point.name] = effect
        return effects


def defined_in(package: str, folders: Iterable[str]) -> Iterator[Effect]:
    """The effects that the modules of a package define: one of each class that has a name of its own."""
    for entry in pkgutil.iter_modules(folders, f"{package}."):
        module = importlib.import_module(entry.name)
        for kind in vars(module).values():
            defined_here = isinstance(kind, type) and kind.__module__ == entry.name and "name" in vars(kind)
            if defined_here and issubclass(kind, Effect):
                yield kind()


def _load(point: EntryPoint) -> Effect | None:
    try:
        kind = point.load()
        effect = kind() if isinstance(kind, type) else kind
    except Exception as error:  # whatever a stranger's module does when it is imported
        _log.warning("effect %r (%s) cannot be loaded and is left out: %s", point.name, point.value, error)
        return None
    if not isinstance(effect, Effect):
        _log.warning("effect %r (%s) is left out: it is no agent.model.effects.Effect", point.name, point.value)
        return None
    missing = [attribute for attribute in _DESCRIBED_BY if not getattr(effect, attribute, "")]
    if missing or effect.name != point.name:
        why = f"it lacks {', '.join(missing)}" if missing else f"it calls itself {effect.name!r}"
        _log.warning("effect %r (%s) is left out: %s", point.name, point.value, why)
        return None
    return effect
