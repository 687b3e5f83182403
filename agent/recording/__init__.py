"""Logs of motions: written while the motion runs, read from whoever wrote them, imported from tables."""

from agent.recording.importer import import_log
from agent.recording.log import Log, Repair
from agent.recording.mcap.log_file import write_log
from agent.recording.mcap.output import RecordingError
from agent.recording.mcap.writer import LogWriter
from agent.recording.reading import read_log
from agent.recording.resampling import resampled

__all__ = ["Log", "LogWriter", "RecordingError", "Repair", "import_log", "read_log", "resampled", "write_log"]
