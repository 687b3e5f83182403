"""Texts of generated Python files: a head, tables of numbers, code."""

from __future__ import annotations

import pprint
from typing import Any

from agent.simulators.targets.arm_numbers import ArmNumbers


def module_text(numbers: ArmNumbers, says: str, tables: dict[str, tuple[Any, str]], code: str) -> str:
    """A module: what it `says`, constants with their comments, then `code`."""
    lines = [
        f'"""{says}',
        "",
        f"Written from {numbers.source} by agent export. SI: rad or m, N·m or N, kg, s.",
        '"""',
        "",
    ]
    for name, (value, comment) in tables.items():
        lines += [f"# {comment}", f"{name} = {rounded(value)}"]
    return "\n".join([*lines, "", code.strip(), ""])


def rounded(value: Any) -> str:
    """A constant as Python; numbers with nine digits."""
    return pprint.pformat(_digits(value), width=110, sort_dicts=False)


def _digits(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _digits(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(_digits, value))
    return float(f"{value:.9g}") if isinstance(value, float) else value


def scaled(value: float, low: float, high: float) -> tuple[float, float] | None:
    """A range as factors of the value; None where the value is zero."""
    return (max(low, 0.0) / value, high / value) if value > 0 else None
