"""Whether a recalibration is due, given that the clock may be or have been wrong. All times carry their zone."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from agent.runs.past_run import PastRun

#: A run counts as due this share of its interval early: no timer is exact to the second.
_EARLY = 0.01
#: A timer goes by local time: once a year a day lasts 23 hours, and the timer may be some minutes late.
_SHORT_DAY = timedelta(hours=1, minutes=15)
_DAY = timedelta(days=1)


def too_early(past: PastRun, every: float, now: datetime) -> str:
    """Why a run is not due yet, `every` seconds after the last accepted one; empty where it is."""
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
