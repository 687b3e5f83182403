"""What the Tab key completes: names that a command knows, and files of the kind that it takes."""

from __future__ import annotations

import glob
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path


def drivers(incomplete: str) -> list[str]:
    """Drivers that are installed."""
    from drivers import registry

    return _starting(registry.available(), incomplete)


def effects(incomplete: str) -> list[str]:
    """Effects of the catalogue."""
    from agent.model import CATALOGUE

    return _starting((effect.name for effect in CATALOGUE.built_in), incomplete)


def efforts(incomplete: str) -> list[str]:
    """What the effort of a log may be."""
    from agent.recording import EFFORTS

    return _starting(EFFORTS, incomplete)


def emulator(words: list[str], incomplete: str) -> list[str]:
    """Options of the emulator after these words, or values of the last one; it is another program, and says them."""
    called = [sys.executable, "-m", "fake_controller", "--help"]
    usage = subprocess.run(called, capture_output=True, text=True, check=False).stdout
    values = dict(re.findall(r"(--[a-z-]+)(?: \{([^}]*)\})?", usage.partition("\n\n")[0]))
    option = words[-1] if words else ""
    if option == "--robot":
        return robots(incomplete)
    return _starting((values[option] or "").split(",") if values.get(option) else values, incomplete)


def estimators(incomplete: str) -> list[str]:
    """Estimation methods that a recipe may name."""
    from agent.recipe import ESTIMATION_METHODS

    return _starting(ESTIMATION_METHODS, incomplete)


def recipes(incomplete: str) -> list[str]:
    """Recipe files, and folders on the way to them."""
    return _files(incomplete, ".yaml", ".yml")


def robots(incomplete: str) -> list[str]:
    """Built-in robots, descriptions, and files of simulators."""
    from agent.robot import builtin_robots

    return [*_starting(builtin_robots(), incomplete), *_files(incomplete, ".yaml", ".urdf", ".xml")]


def simulators(incomplete: str) -> list[str]:
    """Simulators that get files of their own."""
    from agent.simulators import TARGETS

    return _starting(TARGETS, incomplete)


def structures(incomplete: str) -> list[str]:
    """Structures of a model."""
    return _starting(("rigid", "auto"), incomplete)


def vendors(incomplete: str) -> list[str]:
    """Robot vendors whose words a load is written in."""
    from agent.simulators import VENDORS

    return _starting(VENDORS, incomplete)


def _starting(names: Iterable[str], incomplete: str) -> list[str]:
    return sorted(name for name in names if name.startswith(incomplete))


def _files(incomplete: str, *suffixes: str) -> list[str]:
    """Paths as the user began to write them; a folder ends in `/`."""
    paths = [Path(name) for name in glob.glob(f"{glob.escape(incomplete)}*")]
    return sorted(
        f"{path}/" if path.is_dir() else str(path) for path in paths if path.is_dir() or path.suffix in suffixes
    )
