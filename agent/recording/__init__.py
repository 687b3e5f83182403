"""Logs of motions: written while the motion runs, read from whoever wrote them, imported from tables."""

from agent.recording.column_names import named_joints, prefixed
from agent.recording.datasets import (
    DATASET_PRESETS,
    counted_apart,
    is_dataset,
    joint_pairs,
    number_of,
    write_targets,
)
from agent.recording.datasets.episodes import HELD, HOLD, SMOOTH
from agent.recording.importer import import_log
from agent.recording.inputs import import_dataset, read_recording, recorded_joints
from agent.recording.log import PARTS, PLANNED_PARTS, SHORTEST_STOP, Log, machines_of
from agent.recording.mcap.foxglove import FILTERED, FOXGLOVE_LAYOUT, PREDICTED, RESIDUAL, foxglove_layout
from agent.recording.mcap.log_file import write_log
from agent.recording.mcap.relabel import LogCopy
from agent.recording.mcap.topics import is_nameless
from agent.recording.mcap.writer import LogWriter
from agent.recording.reading import read_log
from agent.recording.repair.effort import EFFORTS, check_effort, effort_of, with_joint_torque
from agent.recording.repair.grid import line, sample_numbers, settled
from agent.recording.scratch import Scratch
