"""`agent doctor`: what is installed, what this computer allows, and what to do where something is wrong."""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import shutil
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement

from agent.core import available_cores, counted
from agent.pipeline.setup.findings import CheckedItem, Findings
from drivers.registry import available

PACKAGE = "calibration-agent"
#: Free space [MB] below which the next run may not fit: twice what the quickstart writes.
SPACE = 200
#: Answer of adjtimex(2) where no time server sets the clock, and more bytes than its argument has.
_UNSYNCHRONISED, _TIMEX_BYTES = 5, 512
_WRONG = 1


def examine_installation(runs: Path) -> Findings:
    """Versions, extras, compiled functions, drivers, clock, disk and limits. Moves nothing and opens no link.

    Parameters
    ----------
    runs : folder of the runs, which need not exist yet.
    """
    findings = [_python(), *_packages(), _compiled(), _drivers(), _ros(), _clock(), _disk(runs), _limits()]
    return Findings(tuple(findings), "doctor/1")


def _python() -> CheckedItem:
    text = f"{platform.python_version()} at {sys.executable}, on {platform.platform()}"
    if sys.dont_write_bytecode:
        text += "; PYTHONDONTWRITEBYTECODE makes every start slower, unset it"
    return CheckedItem("python", text)


def _packages() -> Iterator[CheckedItem]:
    try:
        installed = distribution(PACKAGE)
    except PackageNotFoundError:
        yield CheckedItem("agent", "is not installed; in its folder, run: pip install .", _WRONG)
        return
    yield CheckedItem("agent", f"{installed.version} in {Path(__file__).parents[2]}, recipes in {_recipes(installed)}")
    requirements = [Requirement(line) for line in installed.requires or ()]
    wrong = _unmet(requirements, "")
    if wrong:
        yield CheckedItem("packages", f"{'; '.join(wrong)}; run: pip install --upgrade {PACKAGE}", _WRONG)
    else:
        versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "pin"))
        yield CheckedItem("packages", f"all that are needed; {versions}")
    for extra in sorted(set(installed.metadata.get_all("Provides-Extra") or ()) - {"dev"}):
        missing = _unmet(requirements, extra)
        text = f"{'; '.join(missing)}; to use it: pip install '{PACKAGE}[{extra}]'" if missing else "installed"
        yield CheckedItem(f"extra {extra}", text)


def _unmet(requirements: list[Requirement], extra: str) -> list[str]:
    """Missing requirements of an extra, or of the package itself ("")."""
    unmet = []
    for requirement in requirements:
        needing = [
            name for name in ("", extra) if requirement.marker is None or requirement.marker.evaluate({"extra": name})
        ]
        if needing[:1] != [extra]:
            continue
        try:
            installed = version(requirement.name)
        except PackageNotFoundError:
            unmet.append(f"{requirement.name} is not installed")
        else:
            if not requirement.specifier.contains(installed, prereleases=True):
                unmet.append(f"{requirement.name} {installed} is installed, {requirement.specifier} is needed")
    return unmet


def _recipes(installed: Distribution) -> Path:
    """The folder of the recipes: in an installed package, or in the checkout."""
    shipped = (file for file in installed.files or () if file.name == "ns16_quickstart.yaml")
    for file in shipped:
        return Path(str(installed.locate_file(file))).resolve().parent
    return Path(__file__).parents[3] / "recipes"


def _compiled() -> CheckedItem:
    started = time.monotonic()
    try:
        import agent.compiled as loops

        stats = [getattr(loops, name).stats for name in dir(loops)]
    except ImportError as error:
        return CheckedItem("compiled cache", f"cannot be loaded: {error}", _WRONG)
    took = f"{counted(len(stats), 'function')} in {time.monotonic() - started:.1f} s"
    folder = stats[0].cache_path
    if folder is None:
        here = Path(loops.__file__).parent
        text = f"{took}, and again in every command: make {here} writable, or set NUMBA_CACHE_DIR to a folder that is"
        return CheckedItem("compiled cache", text, _WRONG)
    fresh = any(statistics.cache_misses for statistics in stats)
    return CheckedItem("compiled cache", f"{took}, {'compiled now and kept in' if fresh else 'read from'} {folder}")


def _drivers() -> CheckedItem:
    return CheckedItem("drivers", ", ".join(available()))


def _ros() -> CheckedItem:
    """ROS 2 as this Python sees it."""
    if find_spec("rclpy") is None:
        return CheckedItem("ros 2", "not here; for driver ros2, source it first: source /opt/ros/jazzy/setup.bash")
    facts = {
        "distribution": os.environ.get("ROS_DISTRO", "not sourced"),
        "RMW": os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp (default)"),
        "domain": os.environ.get("ROS_DOMAIN_ID", "that of the recipe's address"),
        "discovery range": os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET (default)"),
    }
    text = ", ".join(f"{name} {value}" for name, value in facts.items())
    if find_spec("control_msgs") is None:
        text += (
            "; control_msgs is missing, so trajectories go by topic and bring no tolerance: apt-get install "
            "ros-$ROS_DISTRO-control-msgs, then source again"
        )
    return CheckedItem("ros 2", text)


def _clock() -> CheckedItem:
    now = datetime.now(UTC)
    installed = datetime.fromtimestamp(Path(__file__).stat().st_mtime, UTC)
    text = f"{now:%Y-%m-%d %H:%M:%S} UTC"
    if now < installed:
        text += f" is before the agent was installed ({installed:%Y-%m-%d}); set the clock (timedatectl)"
        return CheckedItem("clock", text, _WRONG)
    linux = sys.platform == "linux"
    if linux and ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)) == _UNSYNCHRONISED:
        text += ", not set by a time server; to change that: timedatectl set-ntp true"
    return CheckedItem("clock", text)


def _disk(runs: Path) -> CheckedItem:
    folder = next(each for each in (runs.absolute(), *runs.absolute().parents) if each.is_dir())
    free = shutil.disk_usage(folder).free / 1e6
    if not os.access(folder, os.W_OK):
        return CheckedItem("disk", f"{folder} is not writable; name another folder with --logs", _WRONG)
    if free < SPACE:
        text = f"{free:.0f} MB free in {folder}, a run may need {SPACE} MB; free some, or name another with --logs"
        return CheckedItem("disk", text, _WRONG)
    return CheckedItem("disk", f"{free / 1e3:.1f} GB free in {folder}")


def _limits() -> CheckedItem:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    nice = getattr(resource, "RLIMIT_NICE", None)
    priority = "priority cannot be raised while an arm moves; to allow it, set nice in /etc/security/limits.conf"
    if os.geteuid() == 0 or (nice is not None and resource.getrlimit(nice)[0] > 20):
        priority = "priority can be raised while an arm moves"
    cores = counted(available_cores(), "core")
    return CheckedItem("limits", f"{cores}, {memory:.1f} GB of memory, {files} open files, {priority}")
