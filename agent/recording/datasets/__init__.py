"""Recordings of positions and commands as simulators' users have them: one leaf for each format, found by `FORMATS`."""

from agent.recording.datasets.formats import DATASET_PRESETS, dataset_logs, is_dataset, open_dataset
from agent.recording.datasets.joints import counted_apart, joint_pairs, number_of
from agent.recording.datasets.lerobot_writer import write_targets
