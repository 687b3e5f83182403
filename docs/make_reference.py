"""Writes docs/reference.md from the code: commands, options, recipe keys, exit codes, effects.

`python docs/make_reference.py` writes it; a test fails where it is out of date.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def reference() -> str:
    """The page."""
    lines = ["# Reference", "", "Written from the code by `docs/make_reference.py`.", "", "## Commands", ""]
    lines += _commands()
    lines += ["## Exit codes", "", "| code | class | what |", "| --- | --- | --- |", *_exit_codes(), ""]
    lines += ["## Recipe keys", "", "| key | type | default |", "| --- | --- | --- |", *_keys(), ""]
    lines += ["## Effects", "", *_effects(), ""]
    lines += ["## Effects of the emulator", "", *_simulated(), ""]
    lines += ["## Limits of the diagnosis", "", *_limits(), ""]
    return "\n".join(lines)


def _commands() -> Iterator[str]:
    import typer.main

    from agent.cli.app import app

    group = typer.main.get_command(app)
    found = {name: command for name, command in group.commands.items() if not hasattr(command, "commands")}
    for outer, inner in group.commands.items():
        found |= {f"{outer} {name}": command for name, command in getattr(inner, "commands", {}).items()}
    for name in sorted(found):
        command = found[name]
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        options = [p for p in command.params if p.param_type_name == "option" and p.name != "help"]
        usage = " ".join(["agent", name, *(_metavar(p) for p in arguments)])
        yield from (f"### `{usage}`", "", (command.help or "").strip(), "")
        if options:
            yield from ("| option | what | default |", "| --- | --- | --- |")
            yield from (_option(option) for option in options)
            yield ""


def _metavar(argument: Any) -> str:
    return argument.metavar or argument.name.upper()


def _option(option: Any) -> str:
    flags = " / ".join(", ".join(names) for names in (option.opts, option.secondary_opts) if names)
    value = "" if option.is_flag else f" {option.metavar or option.name.upper()}"
    default = "" if option.is_flag or option.default in (None, ()) else f"`{option.default}`"
    need = "required" if option.required else default
    return f"| `{flags}{value}` | {option.help or ''} | {need} |"


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


def _keys() -> Iterator[str]:
    from agent.recipe.schema import RecipeDocument

    yield from _section(RecipeDocument, "")


def _section(model: Any, path: str) -> Iterator[str]:
    from pydantic import BaseModel

    for name, field in model.model_fields.items():
        key = path + (field.alias or name)
        kinds = [field.annotation, *getattr(field.annotation, "__args__", ())]
        inner = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)]
        if inner and not str(field.annotation).startswith("list"):
            yield from _section(inner[0], f"{key}.")
            continue
        yield f"| `{key}` | {_kind(model, name, field)} | {_default(field)} |"


def _kind(model: Any, name: str, field: Any) -> str:
    schema = model.model_json_schema(by_alias=True)["properties"][field.alias or name]
    options = schema.get("enum") or next((o["enum"] for o in schema.get("anyOf", []) if "enum" in o), None)
    if options:
        return ", ".join(f"`{option}`" for option in options)
    if "description" in schema:
        return schema["description"]
    kinds = [schema.get("type"), *(option.get("type") for option in schema.get("anyOf", []))]
    words = {"array": "list", "string": "text", "integer": "whole number", "object": "mapping"}
    return next((words.get(kind, kind) for kind in kinds if kind and kind != "null"), "name")


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    value = getattr(field.default, "value", field.default)
    return "" if value is None or value in ([], {}) else f"`{value}`"


def _effects() -> Iterator[str]:
    """The built-in ones: what is installed beside them is not ours to describe."""
    from agent.model.effects import CATALOGUE

    yield "s: direction of sliding as the model's friction reverses; w, x: speed and angle of the axle; τ: torque of"
    yield "the model. Matters from: root mean square torque"
    yield "over nominal."
    yield ""
    names = ("name", "family", "where", "in words", "form", "shows as", "confused with")
    yield f"| {' | '.join(names)} | matters from | source |"
    yield "|" + " --- |" * 9
    for effect in CATALOGUE.built_in:
        cells = (
            f"`{effect.name}`",
            effect.family,
            effect.scope,
            effect.phrase,
            effect.formula,
            effect.signature,
            ", ".join(effect.confused_with) or "-",
            f"{100 * effect.practical:g} %",
            effect.source,
        )
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _simulated() -> Iterator[str]:
    from fake_controller.effects_list import listed_effects

    yield "`agent emulator --list-effects` prints them. Joints go by their names, as in `joint_4`."
    yield ""
    yield "| effect | joints | parameters: unit, default | what it does |"
    yield "| --- | --- | --- | --- |"
    for effect in listed_effects():
        parameters = "; ".join(
            f"`{name}`: {', '.join(filter(None, (unit, default)))}" for name, unit, default in effect.parameters
        )
        cells = (f"`{effect.name}`", effect.joints, parameters, effect.words)
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _limits() -> Iterator[str]:
    from agent.diagnosis.law import LAW
    from agent.diagnosis.limits import LIMITS, described

    yield "| number | value | unit | meaning | source |"
    yield "|" + " --- |" * 5
    for limit in (*described(LAW), *described(LIMITS)):
        values = limit.value if isinstance(limit.value, tuple) else (limit.value,)
        value = ", ".join(f"{entry:.3g}" for entry in values)
        yield "| " + " | ".join((f"`{limit.name}`", value, limit.unit, limit.meaning, limit.source)) + " |"


if __name__ == "__main__":
    (ROOT / "docs" / "reference.md").write_text(reference(), encoding="utf-8")
