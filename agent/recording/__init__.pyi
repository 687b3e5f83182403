from .importer import import_log as import_log, mapped_joints as mapped_joints
from .log import PARTS as PARTS, PLANNED_PARTS as PLANNED_PARTS, Log as Log, machines_of as machines_of
from .mcap.foxglove import (
    FILTERED as FILTERED,
    FOXGLOVE_LAYOUT as FOXGLOVE_LAYOUT,
    PREDICTED as PREDICTED,
    RESIDUAL as RESIDUAL,
    foxglove_layout as foxglove_layout,
)
from .mcap.log_file import write_log as write_log
from .mcap.relabel import LogCopy as LogCopy
from .mcap.writer import LogWriter as LogWriter
from .reading import logged_joints as logged_joints, read_log as read_log
from .repair.grid import line as line, sample_numbers as sample_numbers, settled as settled
from .scratch import Scratch as Scratch
