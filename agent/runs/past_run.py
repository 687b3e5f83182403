"""A past run, read from its folder, and whether the next one is due. Every value is checked before it is used."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from agent.core import InputError, error_text, read_json, sha256_text
from drivers.texts import public_address

#: Difference between two clocks that still counts as normal.
AHEAD = timedelta(minutes=5)
#: A run counts as due this share of its interval early: no timer is exact to the second.
_EARLY = 0.01
#: A timer goes by local time: once a year a day lasts 23 hours, and the timer may be some minutes late.
_SHORT_DAY = timedelta(hours=1, minutes=15)
_DAY = timedelta(days=1)
Value = TypeVar("Value")
_KEYED = re.compile(r"\S+ \S*,… [0-9a-f]{12}")


def controller_key(text: str) -> str:
    """Driver and address of a controller; the address's options, which may be secret, are replaced by a digest."""
    driver, _, address = text.partition(" ")
    public = public_address(address)
    if public == address or _KEYED.fullmatch(text):
        return text
    return f"{driver} {public} {sha256_text(address)[:12]}"


@dataclass(frozen=True)
class PastRun:
    """One run folder.

    Attributes
    ----------
    kind : `calibrate`, `recalibrate` or `diagnose`.
    status : that of the run folder; with a gate, `finished` means accepted and `rejected` not.
    loop, program : key of its stored loop, SHA-256 of its program.
    reference : run whose model it was compared with.
    reason : why it was rejected or stopped.
    worst : largest normalised RMSE of any axis.
    data : joints, normalised_rmse, gate, conditions of the run, `verdict` of a diagnosis, and `watch`, the messages of
        the trends after the run.
    """

    run: str
    robot: str
    serial: str
    kind: str
    started: str
    status: str
    controller: str
    loop: str
    program: str
    reference: str
    reason: str
    worst: float | None
    data: dict[str, Any] = field(default_factory=dict)

    @property
    def time(self) -> datetime:
        """When it was started."""
        return datetime.fromisoformat(self.started)

    def in_future(self, now: datetime | None = None) -> bool:
        """Whether it is dated in the future, so that one of the clocks was wrong."""
        return self.time > (now or datetime.now(UTC)) + AHEAD

    @property
    def complete(self) -> bool:
        """Whether it reached its end."""
        return self.status in ("finished", "rejected")

    @property
    def accepted(self) -> bool:
        """Whether its gate let it through."""
        return self.status == "finished" and self.kind != "diagnose"

    @property
    def judged(self) -> bool:
        """Whether its gate could judge any joint."""
        return not self.data["joints"] or len(self.data["not_judged"]) < len(self.data["joints"])

    @property
    def worst_torque(self) -> float | None:
        """Largest error of any axis [N·m]."""
        return max((torque for torque in self.data["rmse"] if torque is not None), default=None)

    @property
    def worst_text(self) -> str:
        """Largest error of any axis: of nominal torque, or in N·m where no axis has one; "-" where none is known."""
        return error_text(self.worst, self.worst_torque)

    @property
    def outcome(self) -> str:
        """The gate's decision or the diagnosis's verdict, in a word or two."""
        finished = "accepted" if self.accepted else self.data["verdict"].replace("_", " ")
        if self.accepted and not self.judged:
            finished = "not judged"
        return finished if self.status == "finished" else self.status

    def outcome_with(self, current: Collection[str]) -> str:
        """The same, marked where its model is a current one."""
        return f"{self.outcome}, current" if self.run in current else self.outcome

    def __post_init__(self) -> None:
        object.__setattr__(self, "controller", controller_key(self.controller))


def too_early(past: PastRun, every: float, now: datetime) -> str:
    """Why a run is not due yet, `every` seconds after the last accepted one; empty where it is.

    Args:
        past: the last accepted run.
        every: period [s].
        now: with a time zone.
    """
    if past.in_future(now):
        return ""
    interval, age = timedelta(seconds=every), max(timedelta(), now - past.time)
    early = _EARLY * interval + (_SHORT_DAY if interval >= _DAY else timedelta())
    if age >= interval - early:
        return ""
    return (
        f"the last accepted run, {past.run}, is {_span(age)} old; recalibrate.every is {_span(interval)}, so the next "
        f"is due in {_span(interval - age)}"
    )


def wrong_clock(past: PastRun, now: datetime) -> str:
    """Message about a run that is dated in the future; empty where it is not."""
    if not past.in_future(now):
        return ""
    return (
        f"{past.run} is dated {past.time:%Y-%m-%d %H:%M} UTC, and by this computer's clock it is "
        f"{now.astimezone(UTC):%Y-%m-%d %H:%M} UTC: the clock was wrong then, or is now, so a run is taken to be due; "
        "set the clock (timedatectl)"
    )


def _span(span: timedelta) -> str:
    seconds = span.total_seconds()
    for size, name in ((86_400, "d"), (3_600, "h"), (60, "min")):
        if seconds >= size:
            return f"{seconds / size:.1f} {name}"
    return f"{seconds:.0f} s"


@dataclass(frozen=True)
class PastParameter:
    """A parameter as one run found it."""

    name: str
    unit: str
    value: float
    standard_deviation: float


def read_run(path: Path) -> PastRun:
    """Read a run folder without its model.

    Raises:
        InputError: one of its files cannot be read.
    """
    with readable(path):
        return _read_run(path)


def read_parameters(path: Path) -> list[PastParameter]:
    """Read the parameters of a run's model, in the model's order; empty without a model.

    Raises:
        InputError: it cannot be read.
    """
    with readable(path):
        model = _optional(path / "model.json")
        return [
            PastParameter(
                _text(entry["name"], "a parameter's name"),
                _text(entry["unit"], "a parameter's unit"),
                _number(entry["value"], entry["name"]),
                _number(entry["standard_deviation"], entry["name"]),
            )
            for entry in [*model.get("base_parameters", []), *model.get("friction", [])]
        ]


@contextlib.contextmanager
def readable(run: Path) -> Iterator[None]:
    """Turn errors from damaged files of a run, or from those of another version, into one message.

    Raises:
        InputError: with what is missing or wrong, and what to do.
    """
    try:
        yield
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        what = f"{error} is missing in them" if isinstance(error, KeyError) else str(error)
        page = run / "report.html"
        advice = f"its page from then is {page}" if os.path.isfile(page) else "it has no page from then"
        raise InputError(
            f"{run}: files of this run are damaged, or another version of the agent wrote them ({what}); {advice}"
        ) from error


def _read_run(path: Path) -> PastRun:
    state, result = read_object(path / "state.json"), _optional(path / "result.json")
    validation, gate = result.get("validation", {}), result.get("gate", {})
    joints = _list(_text, validation.get("joints", []), "joints")
    figures = _numbers(validation.get("normalised_rmse", []), "normalised_rmse")
    limit, stopped = gate.get("normalised_rmse"), state.get("stopped", {})
    texts = ("serial", "controller", "loop", "program", "reference")
    return PastRun(
        run=_text(path.name, "the name"),
        robot=_text(state["robot"], "robot"),
        kind=_text(state.get("kind", "calibrate"), "kind"),
        started=_in_utc(state["started"]),
        status=_text(state["status"], "status"),
        reason=_one_line(result.get("reason", "") or named_causes(result) or stopped.get("reason", "")),
        worst=max((value for value in figures if value is not None), default=None),
        data={
            "joints": joints,
            "normalised_rmse": figures,
            "rmse": _numbers(validation.get("rmse", []), "rmse"),
            "gate": None if limit is None else _number(limit, "gate"),
            "not_judged": _list(_text, gate.get("not_judged", []), "not_judged"),
            "conditions": _conditions(result.get("conditions", {}), joints),
            "verdict": _text(result.get("verdict", ""), "verdict"),
            "watch": _list(_text, state.get("watch", []), "watch"),
        },
        **{key: _text(state.get(key, ""), key) for key in texts},
    )


def _conditions(recorded: dict[str, Any], joints: list[str]) -> dict[str, Any]:
    """The conditions of a run, once those that the trends use are checked."""
    for level in recorded.get("friction", []):
        if level["joint"] not in joints:
            raise ValueError(f"friction of {level['joint']!r}, which is none of the joints")
        for key in ("speed", "value", "standard_deviation", "from_run_to_run"):
            _number(level[key], key)
    if recorded.get("friction") and len(_numbers(recorded["nominal_torque"], "nominal_torque")) != len(joints):
        raise ValueError("nominal_torque is not one a joint")
    for key in ("rate_per_s", "standard_deviation"):
        _numbers(recorded.get("warm_up", {}).get(key, []), key)
    return recorded


def _one_line(text: str) -> str:
    """A reason on one line; it may come from a controller or have several."""
    return _text(" ".join("".join(c if c.isprintable() else " " for c in text).split()), "reason")


def _in_utc(stamp: str) -> str:
    """The same time in UTC; a time without a zone is taken as UTC."""
    time = datetime.fromisoformat(stamp)
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).astimezone(UTC).isoformat(timespec="seconds")


def read_object(path: Path) -> dict[str, Any]:
    """A JSON file of a run, for use within `readable`.

    Raises:
        ValueError: it cannot be read, or holds no object.
    """
    try:
        data = read_json(path)
    except InputError as error:
        raise ValueError(str(error)) from None
    if not isinstance(data, dict):
        raise ValueError(f"{path.name} holds no object")
    return data


def _optional(path: Path) -> dict[str, Any]:
    return read_object(path) if os.path.lexists(path) else {}


def named_causes(result: dict[str, Any]) -> str:
    """The causes that a diagnosis named, and where; empty for any other run or form."""
    causes = result.get("causes") or ()
    try:
        return "; ".join(f"{cause['effect']} on {', '.join(cause['joints']) or 'the whole arm'}" for cause in causes)
    except (TypeError, KeyError):
        return ""


def _text(value: Any, what: str) -> str:
    """A printable text, as terminals and pages need it."""
    if not isinstance(value, str) or not value.isprintable():
        raise ValueError(f"{what} is no text")
    value.encode()  # half a character is none
    return value


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{what} is no number")
    return float(value)


def _numbers(values: Any, what: str) -> list[float | None]:
    return _list(lambda value, name: None if value is None else _number(value, name), values, what)


def _list(checked: Callable[[Any, str], Value], values: Any, what: str) -> list[Value]:
    if not isinstance(values, list):
        raise ValueError(f"{what} is no list")
    return [checked(value, what) for value in values]
