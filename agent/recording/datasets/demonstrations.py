"""HDF5 files of demonstrations: Isaac Lab's recorder and robomimic, both with `data/demo_N`.

Neither has stamps: a step lasts `dt` times `decimation` of `env_args` [isaaclab utils/datasets], or 1 / `control_freq`
[robomimic docs/datasets].
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, counted, needed, open_regular, sha256_file
from agent.recording.datasets.episodes import FRAME_NUMBER, STAMPS, Episode, Recorded

_MOST_VALUES = 2**26
#: What the action of a step became: the joint set-points, where the term is one of joint positions.
_COMMANDS = "processed_actions"
_ARTICULATIONS = "states/articulation"
_MAP = "If it has joint positions and set-points, name their datasets in a map: agent import --map"


def read_demonstrations(path: Path) -> Recorded:
    """Every demonstration of a file of Isaac Lab. It names no joints: its columns are in the order of the arm.

    Raises:
        InputError: no such file, no absolute joint positions, or actions that are no set-points of joints.
    """
    h5py = needed("h5py", f"{path}: reading HDF5", "tables")
    try:
        with open_regular(path) as regular, h5py.File(regular, "r") as file:
            return _read(path, file)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        if isinstance(error, FileNotFoundError):
            raise InputError(f"{path}: no such file") from None
        raise InputError(f"{path}: not a readable HDF5 file: {error}") from None


def _read(path: Path, file: Any) -> Recorded:
    data = file.get("data")
    demos = (
        [] if data is None or not hasattr(data, "keys") else [name for name in data if re.fullmatch(r"demo_\d+", name)]
    )
    if not demos:
        raise InputError(f"{path}: has no data/demo_0, so neither Isaac Lab nor robomimic wrote it. {_MAP}")
    about = _environment(data.attrs.get("env_args"))
    if "control_freq" in about.get("env_kwargs", {}):
        raise InputError(
            f"{path}: is of robomimic, whose actions are {_controller(about)} commands from -1 to 1, not set-points of "
            f"joints: no servo can be identified from them. {_MAP}"
        )
    simulation = about.get("sim_args", {})
    numbers = [simulation.get("dt"), simulation.get("decimation", about.get("decimation", 1))]
    step = float(np.prod(numbers)) if all(isinstance(number, int | float) for number in numbers) else 0.0
    if not 1e-5 < step < 10:
        raise InputError(f"{path}: env_args says no dt, so the time of a step is unknown. {_MAP}")
    demos.sort(key=lambda name: int(name.removeprefix("demo_")))
    episodes = tuple(_demonstration(path, name, data[name], step) for name in demos)
    notes = (f"{counted(len(demos), 'episode')} at {1 / step:g} Hz (dt times decimation)",)
    facts = {STAMPS: FRAME_NUMBER}
    return Recorded(path, (), episodes, rate=1 / step, facts=facts, sha256=sha256_file(path), notes=notes)


def _demonstration(path: Path, name: str, demo: Any, step: float) -> Episode:
    arms = demo.get(_ARTICULATIONS)
    names = sorted(arms) if arms is not None else []
    command = _array(path, demo, _COMMANDS) if _COMMANDS in demo else None
    if len(names) > 1 and command is not None:  # the commanded one
        names = [each for each in names if np.shape(arms[each].get("joint_position"))[1:] == command.shape[1:]] or names
    if len(names) != 1:
        relative = "obs/joint_pos is relative to the default pose, and " if "obs" in demo and not names else ""
        listed = f"{len(names)} articulations ({', '.join(names)})" if names else "none"
        raise InputError(
            f"{path}: data/{name}: {relative}the absolute positions of one arm are needed at "
            f"{_ARTICULATIONS}/NAME/joint_position; it has {listed}. {_MAP}"
        )
    position = _array(path, arms[names[0]], "joint_position")
    velocity = _array(path, arms[names[0]], "joint_velocity") if "joint_velocity" in arms[names[0]] else None
    if command is not None and command.shape != position.shape:
        sizes = f"{command.shape[1]} set-points for {counted(position.shape[1], 'joint')}, {len(command)} steps"
        raise InputError(f"{path}: data/{name}: {_COMMANDS} has {sizes} and not {len(position)}. {_MAP}")
    return Episode(name, np.arange(len(position)) * step, position, command, velocity)


def _array(path: Path, group: Any, name: str) -> np.ndarray:
    """(K, n)."""
    dataset = group[name]
    size = getattr(dataset, "shape", ("a group",))
    if len(size) != 2 or dataset.size > _MOST_VALUES or dataset.dtype.kind not in "fiu":
        listed = " × ".join(map(str, size))
        raise InputError(f"{path}: {dataset.name} ({listed}) is no table of one row of numbers for each step. {_MAP}")
    return np.asarray(dataset[()], dtype=float)


def _environment(text: Any) -> dict[str, Any]:
    """`env_args`, without what is no mapping in it."""
    try:
        about = json.loads(text) if isinstance(text, (str, bytes)) else None
    except (ValueError, RecursionError):
        about = None
    about = about if isinstance(about, dict) else {}
    parts = {key: part for key in ("env_kwargs", "sim_args") if isinstance(part := about.get(key), dict)}
    return parts | {key: about[key] for key in ("decimation",) if key in about}


def _controller(about: dict[str, Any]) -> str:
    """Type of the controller as robosuite names it, and what it steers."""
    kinds = re.findall(r'"type": "([A-Z_]+)"', json.dumps(about["env_kwargs"])) or ["unknown"]
    hand = next((kind for kind in kinds if kind.startswith(("OSC", "IK"))), None)
    return f"end-effector ({hand})" if hand else f"normalised ({kinds[-1]})"
