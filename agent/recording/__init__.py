"""Logs of motions: written while the motion runs, read from whoever wrote them, imported from tables."""

from agent.recording.log import Log, Repair
from agent.recording.mcap_output import RecordingError
from agent.recording.reading import read_log
from agent.recording.writer import LogWriter

__all__ = ["Log", "LogWriter", "RecordingError", "Repair", "read_log"]
