"""Installed packages: their versions, and those that only an extra of the installation brings."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from agent.core.errors import InputError


def package_version(package: str = "calibration-agent") -> str:
    """Version of a package; "not installed" if it is missing, as in a source folder."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def needed(module: str, what: str, extra: str = "fleet") -> Any:
    """Import an optional package.

    Args:
        module: name to import.
        what: what needs it, for the message.
        extra: of this package that installs it.

    Raises:
        InputError: it is not installed; says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"{what} needs {error.name or module}, which is not installed: pip install 'calibration-agent[{extra}]'"
        ) from None
