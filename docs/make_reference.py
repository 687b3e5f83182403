"""Writes docs/reference.md from the code: commands, options, exit codes, effects, limits of the diagnosis.

`python docs/make_reference.py` writes it; a test fails where it is out of date.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
#: Commands with the same option from which on it is described once.
SHARED = 3


def reference() -> str:
    """The page."""
    lines = ["# Commands and effects", "", "Written from the code by `docs/make_reference.py`.", "", "## Commands", ""]
    lines += _commands()
    lines += ["## Exit codes", "", "| code | class | what |", "| --- | --- | --- |", *_exit_codes(), ""]
    lines += ["## Effects", "", *_effects(), ""]
    lines += ["## Limits of the diagnosis", "", *_limits(), ""]
    return "\n".join(lines)


def _commands() -> Iterator[str]:
    """Options that several commands share, with one help text, stand in a table of their own."""
    import typer.main

    from agent.cli.app import app

    group = typer.main.get_command(app)
    found = {name: command for name, command in group.commands.items() if not hasattr(command, "commands")}
    for outer, inner in group.commands.items():
        found |= {f"{outer} {name}": command for name, command in getattr(inner, "commands", {}).items()}
    rows = {
        name: [_option(p) for p in command.params if p.param_type_name == "option" and p.name != "help"]
        for name, command in found.items()
    }
    times = Counter(row for options in rows.values() for row in options)
    shared = sorted(row for row, count in times.items() if count >= SHARED)
    yield from ("Options of several commands:", "", *shared, "")
    for name in sorted(found):
        arguments = [p for p in found[name].params if p.param_type_name == "argument"]
        usage = " ".join(["agent", name, *(_metavar(p) for p in arguments)])
        yield from (f"### `{usage}`", "", (found[name].help or "").strip(), "")
        also = [row.split("`")[1].split(" ")[0].rstrip(",") for row in rows[name] if row in shared]
        if also:
            yield from (f"Also {', '.join(f'`{option}`' for option in also)}.", "")
        own = [row for row in rows[name] if row not in shared]
        yield from (*own, "") if own else ()


def _metavar(argument: Any) -> str:
    name = argument.metavar or argument.name.upper()
    return name if argument.required else f"[{name}]"


def _option(option: Any) -> str:
    flags = " / ".join(", ".join(names) for names in (option.opts, option.secondary_opts) if names)
    value = "" if option.is_flag else f" {option.metavar or option.name.upper()}"
    default = "" if option.is_flag or option.default in (None, ()) else f" (default `{option.default}`)"
    return f"- `{flags}{value}`: {option.help or ''}{' (required)' if option.required else default}"


def _exit_codes() -> Iterator[str]:
    import agent.core.errors

    yield "| 0 | | done, and accepted where there is a gate |"
    found = [
        e
        for e in vars(agent.core.errors).values()
        if isinstance(e, type) and issubclass(e, agent.core.errors.AgentError)
    ]
    for error in sorted(found, key=lambda e: e.exit_code):
        yield f"| {error.exit_code} | `{error.__name__}` | {(error.__doc__ or '').strip()} |"
    yield "| 129, 130, 131, 143 | | ended by a signal (hang-up, interrupt, quit, terminate), after a controlled stop |"


def _effects() -> Iterator[str]:
    """The built-in ones; an installed effect describes itself."""
    from agent.model.effects import CATALOGUE

    yield "What a diagnosis looks for. s: direction of sliding; w, x: speed and angle of the axle; τ: modelled torque."
    yield "`agent emulator --list-effects` prints what can be built into the emulated robot."
    yield ""
    yield "| name | where | in words | form | matters from (RMS, nominal torque) |"
    yield "|" + " --- |" * 5
    for effect in CATALOGUE.built_in:
        cells = (f"`{effect.name}`", effect.scope, effect.phrase, effect.formula, f"{100 * effect.practical:g} %")
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _limits() -> Iterator[str]:
    from agent.diagnosis.hypotheses.law import LAW
    from agent.diagnosis.limits import LIMITS, described

    yield "| number | value | unit | meaning | source |"
    yield "|" + " --- |" * 5
    for limit in (*described(LAW), *described(LIMITS)):
        values = limit.value if isinstance(limit.value, tuple) else (limit.value,)
        value = ", ".join(f"{entry:.3g}" for entry in values)
        yield "| " + " | ".join((f"`{limit.name}`", value, limit.unit, limit.meaning, limit.source)) + " |"


if __name__ == "__main__":
    (ROOT / "docs" / "reference.md").write_text(reference(), encoding="utf-8")
