"""A copy of a log that says nothing of how, when and on which machine it was recorded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

from agent.core import written_whole
from agent.recording.log import NANO
from agent.recording.mcap.log_file import PLANNED, REFERENCES, RUN, STATES, LogFile
from agent.recording.mcap.scan import scan


class LogCopy:
    """A log to copy as it is, faults of the recorder included, under another first stamp; it is read once.

    `first_stamp` is that of its first sample [ns].
    """

    def __init__(self, source: Path):
        self.source = source
        self._scanned = scan(source)
        self._states = self._scanned.topics[STATES]
        self.first_stamp = min(int(group.stamp.min()) for group in self._states)

    def write(self, target: Path, start: float, facts: Mapping[str, str], padding: int) -> float:
        """Write joint states and set-points.

        Parameters
        ----------
        target : file to write.
        start : stamp [s] of the copy's first sample; receive times are the stamps.
        facts : entries of the record `run` in addition to robot, motion, rate and cycle starts.
        padding : bytes of padding, which hide how well the samples compress.

        Returns
        -------
        Stamp of the last sample [s].
        """
        run, names = self._scanned.metadata[RUN], self._states[0].layout.names
        rate = float(run["sample_rate_hz"]) if "sample_rate_hz" in run else None
        with (
            written_whole(target) as unfinished,
            closing(LogFile(unfinished, names, run["robot"], run["motion"], rate, lambda: start, facts)) as file,
        ):
            for topic in (STATES, REFERENCES, PLANNED):
                for group in self._scanned.topics.get(topic, ()):
                    times = start + (group.stamp - self.first_stamp) / NANO
                    file.write_states(topic, times, group.position, group.velocity, group.effort)
            for cycle in json.loads(run.get("cycle_starts_s", "[]")):
                file.cycle_start(start + cycle)
            file.finish(padding)
        return start + (max(int(group.stamp.max()) for group in self._states) - self.first_stamp) / NANO
