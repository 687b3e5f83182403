"""Small recordings of positions and commands in the formats of their recorders, written by the formats' libraries."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from agent.robot import RobotDescription
from agent.simulators.arm import plain_joint, plain_robot

SO101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
TICK = 2 * np.pi / 4095
STORAGES = {
    "f4": "FloatStorage",
    "f8": "DoubleStorage",
    "f2": "HalfStorage",
    "u2": "BFloat16Storage",
    "u1": "ByteStorage",
}


def arm(names: Sequence[str], slides: Sequence[str] = ()) -> RobotDescription:
    """A chain of joints with these names, and a link each."""
    from xml.etree.ElementTree import fromstring

    links = "".join(f'<link name="l{k}"/>' for k in range(len(names) + 1))
    joints = "".join(
        f'<joint name="{name}" type="{"prismatic" if name in slides else "continuous"}"><parent link="l{k}"/>'
        f'<child link="l{k + 1}"/><axis xyz="0 0 1"/></joint>'
        for k, name in enumerate(names)
    )
    root = fromstring(f'<robot name="arm">{links}{joints}</robot>')
    drives = [plain_joint(name, name in slides, -3.0, 3.0) for name in names]
    return plain_robot("arm", root, f"l{len(names)}", [0, 0, -9.81], drives)


def motion(frames: int, joints: int, rate: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Positions (K, n) [rad] that follow set-points (K, n) [rad] late, every joint in its own way."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None] / rate
    speed, phase = rng.uniform(1, 3, joints), rng.uniform(0, 6, joints)
    return 0.5 * np.sin(speed * (t - 0.1) + phase) + 0.6, 0.5 * np.sin(speed * t + phase) + 0.6


def ticks(values: np.ndarray) -> np.ndarray:
    """The nearest values that an encoder of 4095 ticks a turn has."""
    return np.rint(values / TICK) * TICK


def percent(values: np.ndarray, ranges: Sequence[float]) -> np.ndarray:
    """Percent of calibrated ranges (n,) in ticks, from the middle; of the last joint, the gripper, from its end."""
    scale = np.array([200.0] * (len(ranges) - 1) + [100.0]) / np.array(ranges)
    return values / TICK * scale


def write_lerobot(
    folder: Path,
    episodes: Sequence[tuple[np.ndarray, np.ndarray]],
    names: Any = SO101,
    version: str = "v3.0",
    fps: float = 30,
    actions: Any = None,
    **info: Any,
) -> Path:
    """A dataset of episodes: states and actions (K, n), in the unit that they are to have."""
    features = {
        feature: {"dtype": "float32", "shape": [values.shape[1]], "names": called}
        for feature, values, called in zip(
            ("observation.state", "action"), episodes[0], (names, names if actions is None else actions), strict=True
        )
    }
    (folder / "meta").mkdir(parents=True)
    about = {"codebase_version": version, "fps": fps, "features": features, "total_episodes": len(episodes), **info}
    (folder / "meta/info.json").write_text(json.dumps(about), encoding="utf-8")
    tables = []
    for number, (states, sent) in enumerate(episodes):
        frames = np.arange(len(states))
        lists = {
            name: pa.FixedSizeListArray.from_arrays(pa.array(values.astype(np.float32).ravel()), values.shape[1])
            for name, values in (("observation.state", states), ("action", sent))
        }
        row = {"timestamp": (frames / fps).astype(np.float32), "frame_index": frames}
        tables.append(pa.table(lists | row | {"episode_index": np.full(len(states), number)}))
    chunk = folder / "data/chunk-000"
    chunk.mkdir(parents=True)
    if version.startswith("v2"):
        for number, table in enumerate(tables):
            parquet.write_table(table, chunk / f"episode_{number:06d}.parquet")
    else:
        parquet.write_table(pa.concat_tables(tables), chunk / "file-000.parquet")
    return folder


def tensor(key: str, shape: Sequence[int], kind: str = "FloatStorage", offset: int = 0) -> bytes:
    """The opcodes with which torch.save makes a tensor over the numbers `key` of its zip."""
    stride = [int(np.prod(shape[k + 1 :])) for k in range(len(shape))]
    number = struct.Struct("<cI").pack
    sizes, steps = (b"(" + b"".join(number(b"J", one) for one in many) + b"t" for many in (shape, stride))
    storage = b"(" + text("storage") + f"ctorch\n{kind}\n".encode() + text(key) + text("cpu")
    storage += number(b"J", int(np.prod(shape))) + b"tQ"
    arguments = b"(" + storage + number(b"J", offset) + sizes + steps + b"\x89ccollections\nOrderedDict\n)Rt"
    return b"ctorch._utils\n_rebuild_tensor_v2\n" + arguments + b"R"


def text(value: str) -> bytes:
    """The opcode of a text."""
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def torch_file(path: Path, arrays: dict[str, np.ndarray], damage: dict[str, bytes] | None = None) -> Path:
    """What torch.save writes of a dict of tensors; `damage` replaces entries of the zip, or adds some."""
    items = [
        text(name) + tensor(str(k), values.shape, STORAGES[values.dtype.str[1:]])
        for k, (name, values) in enumerate(arrays.items())
    ]
    entries = {"data.pkl": b"\x80\x02}(" + b"".join(items) + b"u.", "byteorder": b"little", "version": b"3\n"}
    entries |= {f"data/{k}": values.tobytes() for k, values in enumerate(arrays.values())}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in (entries | (damage or {})).items():
            archive.writestr(f"{path.stem}/{name}", data)
    return path
