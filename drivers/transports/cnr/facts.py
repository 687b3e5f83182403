"""What a log should say of a motion on CNR's link beside its samples."""

from __future__ import annotations

from drivers.transports.cnr.motion import CnrMotion
from drivers.transports.cnr.samples import Counts


def motion_facts(motion: CnrMotion, counts: Counts | None) -> dict[str, str]:
    """How the clocks of controller and samples lay in a motion, and what did not come as it should."""
    if motion.match is None:
        return {}
    facts = {} if counts is None else _counted(counts)
    if motion.begun_at is not None:
        facts["motion_start_s"] = f"{motion.begun_at:.6f}"
    alignment = motion.match.alignment()
    if alignment is not None:
        facts["clock_offset_s"] = f"{alignment.offset:.9f}"
        facts["clock_offset_uncertainty_s"] = f"{alignment.offset_deviation:.3g}"
        facts["clock_offset_at_controller_time_s"] = f"{alignment.middle:.3f}"
        facts["clock_drift_ppm"] = f"{1e6 * alignment.drift:.3g}"
        facts["clock_drift_uncertainty_ppm"] = f"{1e6 * alignment.drift_deviation:.3g}"
        facts["clock_feedbacks"] = str(alignment.count)
    return facts


def _counted(counts: Counts) -> dict[str, str]:
    """What did not come as it should, for a log; nothing where all did."""
    missing = {f"missing_{name}": str(count) for name, count in counts.missing.items()}
    others = {"late": counts.late, "duplicate": counts.duplicate, "damaged": counts.damaged}
    return {**missing, **{f"{name}_messages": str(count) for name, count in others.items()}}
