"""YAML documents read into pydantic models, with every fault named by file, line and key."""

from __future__ import annotations

import contextlib
import copy
import difflib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from agent.core.errors import InputError
from agent.core.files import open_regular
from agent.core.output import without_secrets
from agent.core.units import kind_of
from drivers.texts import printable

Model = TypeVar("Model", bound=BaseModel)
#: Lists and mappings within each other; more is no document of ours, and costs a parser seconds.
DEEPEST = 50
#: Bytes of a YAML file, characters of one value in it, and values once every alias is written out.
LARGEST_YAML, LONGEST_VALUE, MOST_VALUES = 256 << 10, 10_000, 100_000
#: Bytes of a JSON file; the largest that the agent writes, a model with its covariance, has a few million.
LARGEST_JSON = 64 << 20
#: Bytes of a URDF or an MJCF, and of a robot program; the largest public robot files have a few million.
LARGEST_ROBOT_FILE, LARGEST_PROGRAM = 64 << 20, 16 << 20
#: Characters of a key or of a fault that are shown.
_SHOWN = 600


def load_document(path: Path, model: type[Model]) -> Model:
    """Read a YAML file into `model`.

    Raises:
        InputError: the file is missing, is not YAML, or breaks the model; every fault is listed as
            ``file:line: key: what is wrong``.
    """
    return validate_document(path, read_yaml(path), model)


def read_yaml(path: Path) -> Any:
    """Parse a YAML 1.2 file; mappings keep the line of each key (ruamel's round-trip types).

    Raises:
        InputError: missing, unreadable or malformed file.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    text = read_text(Path(path), LARGEST_YAML)
    yaml, look = YAML(typ="rt"), _Bounds(path).look

    class BoundedParser(yaml.Parser):  # type: ignore[misc, name-defined]
        def get_event(self) -> Any:
            return look(super().get_event())

    yaml.Parser = BoundedParser
    try:
        data = yaml.load(text)
    except InputError:
        raise
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise InputError(f"{path}:{line}: not valid YAML: {error.problem}") from None
    except YAMLError as error:
        raise InputError(f"{path}: not valid YAML: {str(error).partition(chr(10))[0]}") from None
    except Exception as error:  # ruamel raises plain Python errors for dates, tags and depths that it cannot build
        what = "a number of too many digits" if "integer string conversion" in str(error) else str(error)[:_SHOWN]
        raise InputError(f"{path}: not valid YAML: {type(error).__name__}: {what}") from None
    if data is None:
        raise InputError(f"{path}: the file is empty")
    return data


def read_bytes(path: Path, largest: int) -> bytes:
    """The content of a regular file.

    Args:
        largest: bytes; a longer file is not read.

    Raises:
        InputError: missing, unreadable, a pipe or device, or too long.
    """
    try:
        with open_regular(path) as file:
            data = file.read(largest + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # or a name with a null byte
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(data) > largest:
        size = f"{largest >> 20} MiB" if largest >> 20 else f"{largest >> 10} KiB"
        raise InputError(f"{path}: longer than {size}; is it the right file?")
    return data


def read_text(path: Path, largest: int) -> str:
    """A text file that a person wrote; an end of line is a line feed.

    Args:
        largest: bytes; a longer file is not read.

    Raises:
        InputError: missing, unreadable, a pipe or device, not UTF-8 or too long.
    """
    try:
        text = read_bytes(path, largest).decode("utf-8")
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as text: {error}") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


class _Bounds:
    """Limits the size of a YAML document while it is parsed."""

    def __init__(self, path: Path):
        self._path = path
        self._sizes: dict[str, int] = {}
        self._open: list[tuple[str | None, int]] = []  # anchor, and values before it
        self._total = 0

    def look(self, event: Any) -> Any:
        """Check a parser event; returns it unchanged.

        Raises:
            InputError: nested too deep, a value that is too long, or aliases that grow into too many values.
        """
        from ruamel.yaml import events as kinds

        position = f"{self._path}:{event.start_mark.line + 1}"
        anchor = getattr(event, "anchor", None)
        if isinstance(event, kinds.AliasEvent) and anchor is not None:
            if any(anchor == name for name, _ in self._open):
                raise InputError(f"{position}: *{anchor[:40]} stands within what it names")
            self._total += self._sizes.get(anchor, 0)
        elif isinstance(event, kinds.ScalarEvent):
            if len(event.value) > LONGEST_VALUE:
                raise InputError(f"{position}: a value of {len(event.value)} characters; {LONGEST_VALUE} are allowed")
            self._total += 1
            if anchor:
                self._sizes[anchor] = 1
        elif isinstance(event, kinds.CollectionStartEvent):
            self._open.append((anchor, self._total))
            self._total += 1
            if len(self._open) > DEEPEST:
                raise InputError(
                    f"{position}: lists and mappings are nested more than {DEEPEST} deep; a bracket missing?"
                )
        elif isinstance(event, kinds.CollectionEndEvent):
            name, before = self._open.pop()
            if name:
                self._sizes[name] = self._total - before
        if self._total > MOST_VALUES:
            raise InputError(f"{position}: more than {MOST_VALUES} values, aliases written out; leave aliases out")
        return event


def read_json(path: Path) -> Any:
    """Parse a JSON file that the agent, or somebody else, wrote.

    Raises:
        InputError: missing, unreadable, not UTF-8, not JSON, nested too deep, or longer than 64 MiB.
    """
    data = read_bytes(path, LARGEST_JSON)
    try:
        return json.loads(data.decode("utf-8"))
    except RecursionError:
        raise InputError(f"{path}: damaged: lists and objects are nested too deep") from None
    except ValueError as error:  # text that is no UTF-8 or no JSON, a number of thousands of digits
        raise InputError(f"{path}: damaged: {str(error)[:200]}") from None


def validate_document(path: Path, data: Any, model: type[Model]) -> Model:
    """Validate what `read_yaml` returned.

    Args:
        path: of the file, for messages.
        data: what `read_yaml` returned.
        model: pydantic model of the document.

    Raises:
        InputError: with one line per fault.
    """
    faults = find_faults(path, data, model)
    if faults:
        raise InputError("\n".join(faults.values()))
    return model.model_validate(data)


def find_faults(path: Path, data: Any, model: type[BaseModel]) -> dict[tuple[Any, ...], str]:
    """Faults in the data that `read_yaml` returned: a line for people by the location of each fault.

    Args:
        path: of the file, for messages.
        data: what `read_yaml` returned.
        model: pydantic model of the document.
    """
    if not isinstance(data, dict):
        return {(): f"{path}:1: a mapping of keys is expected, not {kind_of(data)}"}
    try:
        model.model_validate(data)
    except ValidationError as error:
        return {_location(fault): _describe(path, data, model, fault) for fault in error.errors()}
    return {}


def first_fault(data: Any, model: type[BaseModel]) -> str | None:
    """What is wrong first with plain data, as ``key: what is wrong``; None where nothing is."""
    try:
        model.model_validate(data)
    except ValidationError as error:
        return _described(model, error.errors()[0])
    return None


def without_faults(data: Any, faults: Iterable[tuple[Any, ...]]) -> Any:
    """A copy of a document in which the faulty keys are missing; where one is missing already, what should hold it."""
    locations = {location[: _depth(data, location)] for location in faults}
    corrected = copy.deepcopy(data)
    # from the end, so that earlier list indices stay valid
    for *above, last in sorted((place for place in locations if place), key=_in_order, reverse=True):
        holder = corrected
        with contextlib.suppress(KeyError, IndexError, TypeError):  # gone with what held it
            for key in above:
                holder = holder[key]
            del holder[last]
    return corrected


def line_of(data: Any, location: tuple[Any, ...]) -> int:
    """Line (from 1) of the deepest part of `location` that the document has."""
    line = 1
    with contextlib.suppress(AttributeError, KeyError, TypeError, IndexError):
        for key in location:
            line, data = data.lc.data[key][0] + 1, data[key]
    return line


def _depth(data: Any, location: tuple[Any, ...]) -> int:
    """Number of keys of `location` that exist."""
    for depth, key in enumerate(location):
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):
            return depth
    return len(location)


def _in_order(location: tuple[Any, ...]) -> list[tuple[bool, Any]]:
    return [(isinstance(key, str), key) for key in location]


def _describe(path: Path, data: Any, model: type[BaseModel], fault: Any) -> str:
    return f"{path}:{line_of(data, _location(fault))}: {_described(model, fault)}"


def _described(model: type[BaseModel], fault: Any) -> str:
    location = _location(fault)
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "extra_forbidden":
        allowed = _keys_at(model, location[:-1])
        message = f"unknown key; allowed are {', '.join(allowed)}" if allowed else "unknown key"
        close = difflib.get_close_matches(str(location[-1]), allowed, 1)
        if close:
            message += f" (did you mean {close[0]}?)"
    elif fault["type"] == "missing":
        message = "this key is required and missing"
    elif fault["type"] in ("model_type", "model_attributes_type"):
        message = f"a mapping is expected; its keys are {', '.join(_keys_at(model, location))}"
    else:
        got = "" if location[:1] == ("controller",) else _shown(fault.get("input"))  # an address may hold a password
        if got and got not in message:
            message += f" (got {got})"
    key = printable(".".join(str(part) for part in location) or "document", _SHOWN)
    return f"{key}: {without_secrets(message, _SHOWN)}"


def _shown(value: Any) -> str:
    """A plain value as it was written; nothing for others."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 256:
        return "a number of very many digits"
    return repr(value) if isinstance(value, (str, int, float, bool)) else ""


def _location(fault: Any) -> tuple[Any, ...]:
    return tuple(part for part in fault["loc"] if not (isinstance(part, str) and part.startswith("function-")))


def _keys_at(model: Any, location: tuple[Any, ...]) -> list[str]:
    for part in location:
        if isinstance(part, int):
            continue
        fields = {field.alias or name: field for name, field in getattr(model, "model_fields", {}).items()}
        if part not in fields:
            return []
        model = _model_in(fields[part].annotation)
    return [field.alias or name for name, field in getattr(model, "model_fields", {}).items()]


def _model_in(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        model = _model_in(argument)
        if model is not None:
            return model
    return None
