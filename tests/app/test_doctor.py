"""`agent doctor` names what is missing or wrong, with what to do."""

import json
import os
import shutil
from importlib import metadata
from pathlib import Path

import pytest

from agent.pipeline.setup import doctor


def _messages(runs: Path) -> dict[str, tuple[bool, str]]:
    return {one.subject: (one.ok, one.message) for one in doctor.examine_installation(runs).findings}


@pytest.fixture
def lacking(monkeypatch: pytest.MonkeyPatch):
    """Makes packages look as if nobody had installed them, or another version of them."""

    def lack(**versions: str | None) -> None:
        def version(name: str) -> str:
            if versions.get(name, "") is None:
                raise metadata.PackageNotFoundError(name)
            return versions.get(name) or metadata.version(name)

        monkeypatch.setattr(doctor, "version", version)

    return lack


def test_doctor_lists_what_it_checked(run_agent):
    run = run_agent("doctor", "--json")
    found = json.loads(run.stdout)
    assert (run.returncode, found["schema"], found["ok"]) == (0, "doctor/1", True)
    subjects = {finding["subject"] for finding in found["findings"]}
    assert {"python", "agent", "packages", "extra mujoco", "compiled cache", "clock", "disk", "limits"} <= subjects


def test_names_the_install_command_of_a_missing_extra(lacking, tmp_path: Path):
    lacking(h5py=None, openpyxl=None)
    ok, message = _messages(tmp_path)["extra tables"]
    assert ok
    assert message == (
        "h5py is not installed; openpyxl is not installed; to use it: pip install 'calibration-agent[tables]'"
    )


@pytest.mark.parametrize(("installed", "says"), [(None, "not installed"), ("1.9", "1.9 is installed, >=2 is needed")])
def test_a_missing_required_package_is_a_problem(lacking, tmp_path: Path, installed: str | None, says: str):
    lacking(pydantic=installed)
    ok, message = _messages(tmp_path)["packages"]
    assert not ok
    assert f"pydantic {says}" in message or f"pydantic is {says}" in message
    assert doctor.examine_installation(tmp_path).exit_code == 1


@pytest.mark.parametrize(
    ("packages", "environ", "says"),
    [
        ((), {}, ["source it first"]),
        (
            ("rclpy",),
            {},
            [
                "not sourced",
                "rmw_fastrtps_cpp (default)",
                "recipe's address",
                "SUBNET (default)",
                "control_msgs is missing",
            ],
        ),
        (
            ("rclpy", "control_msgs"),
            {
                "ROS_DISTRO": "jazzy",
                "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp",
                "ROS_DOMAIN_ID": "42",
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            },
            ["distribution jazzy, RMW rmw_cyclonedds_cpp, domain 42, discovery range LOCALHOST"],
        ),
    ],
    ids=["none", "without control_msgs", "sourced"],
)
def test_says_what_ros_2_is_here(monkeypatch, tmp_path: Path, packages, environ, says):
    for name in [name for name in os.environ if name.startswith(("ROS_", "RMW_"))]:
        monkeypatch.delenv(name)
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(doctor, "find_spec", lambda name: name in packages or None)
    ok, message = _messages(tmp_path)["ros 2"]
    assert ok
    assert all(text in message for text in says)
    assert ("control_msgs is missing" in message) is (packages == ("rclpy",))


def test_a_full_disk_is_a_problem(monkeypatch, tmp_path: Path):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9 - 10**6, 10**6))
    ok, message = _messages(tmp_path / "none" / "yet")["disk"]
    assert not ok
    assert message.startswith(f"1 MB free in {tmp_path}")


def test_a_clock_earlier_than_the_installation_is_a_problem(monkeypatch, tmp_path: Path):
    copy = shutil.copy(doctor.__file__, tmp_path)
    os.utime(copy, (4e9, 4e9))
    monkeypatch.setattr(doctor, "__file__", copy)
    ok, message = _messages(tmp_path)["clock"]
    assert not ok
    assert "before the agent was installed (2096-10-02)" in message
