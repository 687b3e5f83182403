"""PACE recordings: `torch.save` of a dict `time`, `dof_pos`, `des_dof_pos`, read without torch.

The file is a zip with a pickle, which may run any code when it is loaded. So nothing loads it: its opcodes are walked,
and the only objects they can make are numbers, texts, containers, and tensors over the bytes of the zip
[pace-sim2real scripts/pace/data_collection.py; torch/serialization.py].
"""

from __future__ import annotations

import pickletools
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, open_regular, sha256_file
from agent.recording.datasets.episodes import Episode, Recorded

#: Field of the file → field of an episode, in rad and s.
_FIELDS = {"time": "time", "dof_pos": "position", "des_dof_pos": "command", "dof_vel": "velocity"}
_NEEDED = ("time", "dof_pos", "des_dof_pos")
#: Fields that some add: names of the joints in the order of the columns.
_NAMES = ("joint_names", "dof_names", "joint_order")
#: Types of the numbers in a storage.
_STORAGES = {
    **{"FloatStorage": "f4", "DoubleStorage": "f8", "HalfStorage": "f2", "BFloat16Storage": "u2", "BoolStorage": "u1"},
    **{"LongStorage": "i8", "IntStorage": "i4", "ShortStorage": "i2", "CharStorage": "i1", "ByteStorage": "u1"},
}
_HALF_OF_FLOAT = "BFloat16Storage"  # the upper two bytes of a float32
#: Limits of the pickle [bytes] and of all numbers: a real one has 300 bytes, an hour of 12 joints at 500 Hz 45 million.
_MOST_PICKLE, _MOST_VALUES, _MOST_AXES = 2**16, 2**26, 8
_TENSOR, _ORDERED = "torch._utils _rebuild_tensor_v2", "collections OrderedDict"


class _Refused(ValueError):
    """What is in the file that no recording has."""


@dataclass(frozen=True)
class _Named:
    """A class or function that the pickle names."""

    name: str


@dataclass(frozen=True)
class _Storage:
    """Numbers in the zip."""

    kind: str
    key: str


def read_pace(path: Path) -> Recorded:
    """The motion in a PACE file. Unless it names the joints, its columns are in the order of the arm.

    Raises:
        InputError: no zip of torch, anything in it but tensors, or sizes that do not fit together.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            content = _content(archive)
        missing = [name for name in _NEEDED if not isinstance(content.get(name), np.ndarray)]
        if missing:
            present = ", ".join(map(str, content)) or "nothing"
            raise _Refused(f"{', '.join(missing)} is missing; it holds {present}")
        arrays = {field: content[name] for name, field in _FIELDS.items() if isinstance(content.get(name), np.ndarray)}
        _check_shapes(arrays)
    except (_Refused, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError) as error:
        what = "no file of torch.save since torch 1.6" if isinstance(error, zipfile.BadZipFile) else str(error)
        raise InputError(
            f"{path}: not read as a PACE recording: {what}. A dict of the tensors {', '.join(_NEEDED)} is expected; "
            "nothing in the file was run"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    listed = next((names for key in _NAMES if isinstance(names := content.get(key), list | tuple)), ())
    joints = tuple(map(str, listed)) if len(listed) == arrays["position"].shape[1] else ()
    return Recorded(path, joints, (Episode(path.stem, **arrays),), sha256=sha256_file(path))


def _check_shapes(arrays: dict[str, np.ndarray]) -> None:
    time = arrays["time"] = np.squeeze(arrays["time"])
    joints = arrays["position"].shape
    if time.ndim != 1 or len(joints) != 2 or any(len(array) != len(time) for array in arrays.values()):
        listed = ", ".join(f"{name} {'×'.join(map(str, array.shape))}" for name, array in arrays.items())
        raise _Refused(f"the sizes do not fit together: {listed}")
    if any(arrays[name].shape != joints for name in arrays if name != "time"):
        raise _Refused("positions and set-points have different numbers of joints")


def _content(archive: zipfile.ZipFile) -> dict[Any, Any]:
    """The dict of a file of torch.save, tensors as arrays."""
    entries = {entry.filename: entry for entry in archive.infolist()}
    pickles = [name for name in entries if name.rsplit("/", 1)[-1] == "data.pkl"]
    if len(pickles) != 1:
        raise _Refused("the zip has no data.pkl of torch.save")
    root = pickles[0].removesuffix("data.pkl")
    if entries[pickles[0]].file_size > _MOST_PICKLE:
        raise _Refused(f"its pickle is larger than {_MOST_PICKLE >> 10} KiB")
    if sum(entry.file_size for entry in entries.values()) > 8 * _MOST_VALUES:
        raise _Refused(f"it unpacks to more than {8 * _MOST_VALUES >> 20} MiB")
    big = f"{root}byteorder" in entries and archive.read(f"{root}byteorder").strip() == b"big"

    def numbers(storage: _Storage) -> np.ndarray:
        name = f"{root}data/{storage.key}"
        if name not in entries:
            raise _Refused(f"the numbers {storage.key} are missing")
        data = archive.read(name)
        kind = np.dtype((">" if big else "<") + _STORAGES[storage.kind])
        if len(data) % kind.itemsize:
            raise _Refused(f"the numbers {storage.key} end within one")
        values = np.frombuffer(data, kind)
        return (values.astype("u4") << 16).view("f4") if storage.kind == _HALF_OF_FLOAT else values

    content = _PickleWalk(numbers).result(archive.read(pickles[0]))
    if not isinstance(content, dict):
        raise _Refused(f"it holds {type(content).__name__}, not a dict of tensors")
    return content


class _PickleWalk:
    """The opcodes of a pickle, of which none calls anything but the two functions that are known here."""

    def __init__(self, numbers: Callable[[_Storage], np.ndarray]):
        self._numbers = numbers
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        self._values = 0

    def result(self, data: bytes) -> Any:
        """The object of the pickle.

        Raises:
            _Refused: it is damaged, or makes anything else than numbers, texts, containers and tensors.
        """
        try:
            for opcode, argument, _ in pickletools.genops(data):
                if opcode.name == "STOP":
                    return self._stack.pop()
                self._step(opcode.name, argument)
        except (IndexError, KeyError, TypeError, ValueError, AttributeError) as error:
            if isinstance(error, _Refused):
                raise
            raise _Refused(f"its pickle is damaged ({error})") from None
        raise _Refused("its pickle does not end")

    def _step(self, name: str, argument: Any) -> None:
        if name in _CONSTANTS:
            self._stack.append(_CONSTANTS[name]())
        elif name in _LITERALS:
            self._stack.append(argument)
        elif name in _ACTIONS:
            _ACTIONS[name](self, argument)
        elif name not in ("PROTO", "FRAME"):
            raise _Refused(f"its pickle does {name}, which no recording needs")

    def _put(self, index: Any) -> None:
        self._memo[len(self._memo) if index is None else int(index)] = self._stack[-1]

    def _get(self, index: Any) -> None:
        self._stack.append(self._memo[int(index)])

    def _mark(self, _: Any) -> None:
        self._marks.append(len(self._stack))

    def _tuple(self, count: int | None) -> None:
        self._stack.append(tuple(self._popped(count)))

    def _set(self, count: int | None) -> None:
        items = self._popped(count)
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str | int):  # the hash of nested tuples may take for ever
                raise _Refused("a key in it is neither text nor number")
            self._stack[-1][key] = value

    def _extend(self, count: int | None) -> None:
        items = self._popped(count)
        self._stack[-1].extend(items)

    def _refer(self, _: Any) -> None:
        self._stack.append(_storage(self._stack.pop()))

    def _reduce(self, _: Any) -> None:
        arguments = self._stack.pop()
        self._stack.append(self._called(self._stack.pop(), arguments))

    def _name(self, name: str | None) -> None:
        name = " ".join(self._popped(2)) if name is None else name
        module, _, what = name.partition(" ")
        if name not in (_TENSOR, _ORDERED) and not (module == "torch" and what in _STORAGES):
            raise _Refused(f"it names {name.replace(' ', '.')}, which is no tensor of numbers")
        self._stack.append(_Named(name))

    def _popped(self, count: int | None) -> list[Any]:
        """The last values of the stack, or those since the last mark."""
        start = self._marks.pop() if count is None else len(self._stack) - count
        if start < (self._marks[-1] if self._marks else 0):
            raise _Refused("its pickle is damaged")
        values = self._stack[start:]
        del self._stack[start:]
        return values

    def _called(self, function: Any, arguments: Any) -> Any:
        if function == _Named(_ORDERED) and arguments in ((), ([],)):
            return {}
        if function != _Named(_TENSOR) or len(arguments) < 4 or not isinstance(arguments[0], _Storage):
            raise _Refused("it calls something else than the making of a tensor")
        storage, offset, size, stride = arguments[:4]
        if not all(isinstance(n, int) and n >= 0 for n in (offset, *size, *stride)) or len(size) != len(stride):
            raise _Refused("a tensor has impossible sizes")
        self._values += int(np.prod(size, dtype=object))
        if self._values > _MOST_VALUES or len(size) > _MOST_AXES:
            raise _Refused(f"its tensors hold more than {_MOST_VALUES} numbers, or have more than {_MOST_AXES} axes")
        values = self._numbers(storage)
        last = offset + sum((count - 1) * step for count, step in zip(size, stride, strict=True))
        if 0 in size:
            return np.empty(size)
        if last >= len(values):
            raise _Refused("a tensor is larger than its numbers")
        axes = (np.arange(count) * step for count, step in zip(size, stride, strict=True))
        return values[offset + sum(np.meshgrid(*axes, indexing="ij"))].astype(float)


def _storage(identity: Any) -> _Storage:
    """('storage', type, key, device, count)."""
    if not (isinstance(identity, tuple) and len(identity) == 5 and isinstance(identity[1], _Named)):
        raise _Refused("it refers to something else than numbers in the zip")
    kind = identity[1].name.removeprefix("torch ")
    if kind not in _STORAGES or not isinstance(identity[2], str):
        raise _Refused(f"numbers of the type {identity[1].name} are not read")
    return _Storage(kind, identity[2])


_CONSTANTS: dict[str, Callable[[], Any]] = {
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
}
_LITERALS = ("BINUNICODE", "SHORT_BINUNICODE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT")
#: What the other opcodes do.
_ACTIONS: dict[str, Callable[[_PickleWalk, Any], None]] = {
    **dict.fromkeys(("BINPUT", "LONG_BINPUT", "PUT", "MEMOIZE"), _PickleWalk._put),
    **dict.fromkeys(("BINGET", "LONG_BINGET", "GET"), _PickleWalk._get),
    "MARK": _PickleWalk._mark,
    "TUPLE": lambda walk, _: walk._tuple(None),
    "TUPLE1": lambda walk, _: walk._tuple(1),
    "TUPLE2": lambda walk, _: walk._tuple(2),
    "TUPLE3": lambda walk, _: walk._tuple(3),
    "SETITEM": lambda walk, _: walk._set(2),
    "SETITEMS": lambda walk, _: walk._set(None),
    "APPEND": lambda walk, _: walk._extend(1),
    "APPENDS": lambda walk, _: walk._extend(None),
    "GLOBAL": _PickleWalk._name,
    "STACK_GLOBAL": _PickleWalk._name,
    "BINPERSID": _PickleWalk._refer,
    "REDUCE": _PickleWalk._reduce,
}
