"""A copy of a log that says nothing of how, when and on which machine it was recorded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from agent.core import written_whole
from agent.recording.mcap.log_file import PLANNED, REFERENCES, RUN, STATES, LogFile
from agent.recording.mcap.scan import scan

_NANO = 1_000_000_000


def relabelled(source: Path, target: Path, start: float, facts: Mapping[str, str], padding: int) -> float:
    """Copy joint states and set-points as they are, faults of the recorder included, under another first stamp.

    Parameters
    ----------
    source, target : Path
        Log to read, and the file to write.
    start : float
        Stamp [s] of the copy's first sample; receive times are the stamps.
    facts : Mapping
        Entries of the record `run` in addition to robot, motion, rate and cycle starts.
    padding : int
        Bytes of padding, which hide how well the samples compress.

    Returns
    -------
    float
        Stamp of the last sample [s].
    """
    found = scan(source)
    run = found.metadata[RUN]
    states = found.topics[STATES]
    first = min(int(group.stamp.min()) for group in states)
    last = max(int(group.stamp.max()) for group in states)
    rate = float(run["sample_rate_hz"]) if "sample_rate_hz" in run else None
    with written_whole(target) as unfinished:
        file = LogFile(unfinished, states[0].layout.names, run["robot"], run["motion"], rate, lambda: start, facts)
        try:
            for topic in (STATES, REFERENCES, PLANNED):
                for group in found.topics.get(topic, ()):
                    times = start + (group.stamp - first) / _NANO
                    file.write_states(topic, times, group.position, group.velocity, group.effort)
            for cycle in json.loads(run.get("cycle_starts_s", "[]")):
                file.cycle_start(start + cycle)
            file.finish(padding)
        finally:
            file.close()
    return start + (last - first) / _NANO


def first_stamp(path: Path) -> int:
    """Stamp of a log's first sample [ns]."""
    return min(int(group.stamp.min()) for group in scan(path).topics[STATES])
