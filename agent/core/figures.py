"""Figures as people read them; nothing heavy is needed for it, so that listing runs is quick."""

from __future__ import annotations

import math


def error_text(share: float | None, torque: float | None, unit: str = "N·m", digits: int = 2) -> str:
    """`share` of nominal torque in percent; where it is None or NaN the torque itself; "-" without either."""
    if share is not None and math.isfinite(share):
        return f"{100 * share:.{digits}f} %"
    if torque is not None and math.isfinite(torque):
        return f"{torque:.3g} {unit}"
    return "-"


def counted(number: int, noun: str) -> str:
    """So many of something, as "1 log" or "3 logs"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def plus_minus(value: float, half: float) -> str:
    """A value with half of its interval, to two digits of the latter: "4.003 ± 0.021"; four digits without one."""
    if not math.isfinite(half) or half <= 0:
        return f"{value:.4g}" if not 1e4 <= abs(value) < 1e6 else f"{float(f'{value:.4g}'):.0f}"
    size = max(abs(value), half)
    if size >= 1e6 or size < 1e-3:
        power = math.floor(math.log10(size))
        return f"({plus_minus(value / 10**power, half / 10**power)})e{power}"
    places = 1 - math.floor(math.log10(half))
    shown = max(0, places)
    return f"{round(value, places) + 0.0:.{shown}f} ± {round(half, places):.{shown}f}"
