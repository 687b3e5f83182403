"""Local calibration of industrial robot dynamics, and diagnosis of the sim-to-real gap.

`import agent as ca` is the front door for Python and notebooks: every function takes paths or loaded objects and
returns a result that prints itself. Nothing is loaded before it is used.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agent.notebook import (
        calibrate,
        diagnose,
        drivers,
        effects,
        estimate,
        export,
        load_recipe,
        load_robot,
        plan,
        read_logs,
        report,
        validate,
    )

__all__ = [
    "calibrate",
    "diagnose",
    "drivers",
    "effects",
    "estimate",
    "export",
    "load_recipe",
    "load_robot",
    "plan",
    "read_logs",
    "report",
    "validate",
]


class _ReportRoom(ModuleType):
    """The package `agent.report`, which is also the function `report` of the front door."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        from agent.notebook import report as write

        return write(*arguments, **named)


class _Front(ModuleType):
    """Python binds a package to its parent when it is first imported, over any function of that name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "report" and isinstance(value, ModuleType):
            value.__class__ = _ReportRoom
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Front


def __getattr__(name: str) -> Any:
    if name == "report":
        import agent.report

        return agent.report
    if name in __all__:
        from agent import notebook

        return getattr(notebook, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
