"""Versions of what is installed."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def package_version(package: str = "calibration-agent") -> str:
    """For people and records; "not installed" where it is not, as from a folder of sources."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
