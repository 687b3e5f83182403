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
