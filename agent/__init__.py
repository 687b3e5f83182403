"""Local calibration of industrial robot dynamics, and diagnosis of the sim-to-real gap.

`import agent as ca` is the front door for Python and notebooks: every function takes paths or loaded objects and
returns a result that prints itself. Nothing is loaded before it is used.
"""

from __future__ import annotations

TYPE_CHECKING = False  # as type checkers read it; nothing is imported before `agent.__main__` looks after signals
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


def __getattr__(name: str) -> object:
    if name in __all__:
        from agent import notebook

        return getattr(notebook, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
