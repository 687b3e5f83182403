"""Figures of the ROS 2 driver against the emulated arm: samples, ages, CPU, memory, stops, and ends of the agent.

    python benchmarks/ros2_link.py [--seconds 60] [--rates 500 1000] [--stops 5]

Needs an environment with ROS 2 (`make ros`). The arm is a process of its own; a third node sees when a brake point
comes. Ages are of samples as they are handed out, by the clock of this computer, and contain how late the emulated arm
published them, which it says itself. Load counts, so it is printed.
"""

from __future__ import annotations

import argparse
import atexit
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np

from drivers.errors import DriverError
from drivers.protocol import Driver
from drivers.registry import create
from drivers.transports.ros2.ros import Ros
from drivers.wire.ros2 import JOINT_STATES, JointStateReader, RosAddress

JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
HOME = np.radians([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])  # of the emulated arm
DOMAIN = 100 + os.getpid() % 100
ADDRESS = f"ros2://{DOMAIN}/joint_trajectory_controller"


def goal(way: float, seconds: float) -> str:
    """All joints out by `way` [rad] and back."""
    t = np.arange(0.0, seconds + 0.01, 0.05)
    phase = 2 * np.pi * t / seconds
    rows = [way * (1 - np.cos(phase)) / 2, way * np.pi / seconds * np.sin(phase)]
    rows.append(way * 2 * (np.pi / seconds) ** 2 * np.cos(phase))
    rows[1][[0, -1]] = rows[2][[0, -1]] = 0.0
    points = []
    for k, value in enumerate(t + 0.2):
        sec, nanosec = divmod(round(value * 1e9), 10**9)
        point = {"positions": (HOME + rows[0][k]).tolist(), "time_from_start": {"sec": sec, "nanosec": nanosec}}
        points.append(point | {"velocities": [rows[1][k]] * 6, "accelerations": [rows[2][k]] * 6})
    tolerance = [{"name": name, "position": 0.15} for name in JOINTS]
    trajectory = {"joint_names": JOINTS, "points": points}
    return json.dumps({"cycles": 1, "goal": {"trajectory": trajectory, "path_tolerance": tolerance}}) + "\n"


def program(*lines: str) -> str:
    """The text of a program `p`."""
    return json.dumps({"program": "p", "joint_names": JOINTS}) + "\n" + "".join(lines)


class Observer:
    """A node that notes when trajectories come, and how fast the arm is."""

    def __init__(self) -> None:
        self._ros = Ros(DOMAIN, f"observer_{os.getpid()}")
        target, reader = RosAddress.of(ADDRESS), JointStateReader(JOINTS)
        self.commands: list[float] = []
        self.speed: list[tuple[float, float]] = []

        def take(data: bytes) -> None:
            sample = reader.read(data)
            if sample is not None:
                self.speed.append((sample.stamp, float(np.abs(sample.velocity).max())))

        topic = target.name(target.controller, "joint_trajectory")
        self._ros.raw("trajectory_msgs.msg", "JointTrajectory", topic, lambda _: self.commands.append(time.time()))
        self._ros.raw("sensor_msgs.msg", "JointState", target.name(JOINT_STATES), take)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._over.is_set():
            self._ros.spin_once(0.05)

    def rest_after(self, moment: float, limit: float) -> float:
        """Seconds from a moment on until the arm rests for a second."""
        while time.time() < moment + limit:
            time.sleep(0.05)
            after = [(stamp, speed) for stamp, speed in list(self.speed) if stamp > moment]
            moved = [stamp for stamp, speed in after if speed > 0.01]
            if after and after[-1][0] - (moved[-1] if moved else moment) > 1.0:
                return (moved[-1] if moved else moment) - moment
        return float("nan")


def emulator(rate: float, log: Path) -> subprocess.Popen[bytes]:
    """The arm, once it says that it is there."""
    words = ["--robot", "ur5e", "--driver", "ros2", "--address", ADDRESS, "--rate", f"{rate:g}"]
    with log.open("wb") as out:
        process = subprocess.Popen([sys.executable, "-m", "fake_controller", *words], stdout=out, stderr=out)
    atexit.register(process.kill)
    while b"fake controller: ur5e" not in log.read_bytes():
        if process.poll() is not None:
            raise SystemExit(log.read_text(encoding="utf-8"))
        time.sleep(0.2)
    return process


def reception(rate: float, seconds: float) -> str:
    """Samples of a motion, and what they cost."""
    driver = create("ros2", ADDRESS)
    driver.connect()
    checksum = driver.upload("p", program(goal(0.2, 5.0), json.dumps({"rest": seconds - 12.0}) + "\n", goal(0.2, 5.0)))
    driver.start("p", checksum)
    wall, cpu, ages, last = time.monotonic(), time.process_time(), [], 0
    for block in driver.samples():
        ages.append(block.received - block.time)
        last = int(block.sequence[-1])
    wall, cpu = time.monotonic() - wall, time.process_time() - cpu
    age = 1e3 * np.concatenate(ages)
    lost = sum(gap.count for gap in driver.gaps)
    more = _private(_second_process(os.getpid()))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    driver.close()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)  # of the second process, from its start on
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return (
        f"{rate:g} Hz, {wall:.0f} s: {last + 1 - lost} of {last + 1} samples; age p50 {np.median(age):.1f} ms, p99 "
        f"{np.quantile(age, 0.99):.1f} ms, largest {age.max():.0f} ms; CPU {100 * cpu / wall:.1f} % of a core, "
        f"{memory:.0f} MiB; second process {100 * spent / wall:.1f} %, {more:.0f} MiB "
        f"of its own; load {os.getloadavg()[0]:.1f}"
    )


def _second_process(agent: int) -> int:
    return int(Path(f"/proc/{agent}/task/{agent}/children").read_text().split()[-1])


def _private(process: int) -> float:
    """Memory [MiB] that a process shares with nobody."""
    rows = [row.split() for row in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()]
    return sum(int(row[1]) for row in rows if row[0].startswith("Private")) / 1024


def agent(way: float, seconds: float) -> None:
    """A motion in this process, which somebody is going to kill."""
    driver = create("ros2", ADDRESS)
    driver.connect()
    driver.start("p", driver.upload("p", program(json.dumps(TO) + "\n", goal(way, seconds))))
    print("started", flush=True)
    for _ in driver.samples():
        pass


def read(driver: Driver) -> None:
    """Samples to the end of a motion, however it ends."""
    try:
        for _ in driver.samples():
            pass
    except DriverError as error:
        print(f"  a motion ended early: {error}", flush=True)


def stops(observer: Observer, count: int) -> str:
    """From the wish to stop to the brake point at the node, and to rest."""
    driver = create("ros2", ADDRESS)
    driver.connect()
    took, rested = [], []
    for _ in range(count):
        driver.start("p", driver.upload("p", program(json.dumps(TO) + "\n", goal(0.5, 8.0))))
        reader = threading.Thread(target=read, args=(driver,))
        reader.start()
        time.sleep(4.0)
        moment, seen = time.time(), len(observer.commands)
        driver.stop()
        rested.append(observer.rest_after(moment, 5.0))
        took += [one - moment for one in observer.commands[seen : seen + 1]]
        reader.join()
    driver.close()
    return (
        f"{count} stops: brake point at the node after {1e3 * min(took):.1f} to {1e3 * max(took):.1f} ms, rest after "
        f"{min(rested):.2f} to {max(rested):.2f} s; load {os.getloadavg()[0]:.1f}"
    )


TO = {"to": HOME.tolist(), "velocity": [1.0] * 6, "acceleration": [2.0] * 6}


def killed(observer: Observer, both: bool) -> str:
    """What the arm does when the agent is killed, and the second process with it or not."""
    child = subprocess.Popen([sys.executable, __file__, "--agent", ADDRESS], stdout=subprocess.PIPE)
    assert child.stdout is not None
    child.stdout.readline()
    time.sleep(3.0)
    brake = _second_process(child.pid)
    time.sleep(4.0)
    seen, moment = len(observer.commands), time.time()
    if both:
        os.kill(brake, signal.SIGKILL)
    child.send_signal(signal.SIGKILL)
    rest = observer.rest_after(moment, 25.0)
    came = [one - moment for one in observer.commands[seen:]]
    child.wait()
    what = "agent and second process" if both else "agent"
    told = f"brake point after {1e3 * came[0]:.0f} ms" if came else "no brake point"
    return f"{what} killed in motion: {told}, rest after {rest:.2f} s; load {os.getloadavg()[0]:.1f}"


def main() -> None:
    """Print one line a figure."""
    global ADDRESS, DOMAIN
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rates", type=float, nargs="*", default=[500.0, 1000.0])
    parser.add_argument("--stops", type=int, default=5)
    parser.add_argument("--agent", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.agent:
        ADDRESS = options.agent
        agent(0.5, 14.0)
        return
    log = Path(f"/tmp/ros2_link_{os.getpid()}.txt")
    for rate in options.rates:
        arm = emulator(rate, log)
        print(reception(rate, options.seconds), flush=True)
        arm.send_signal(signal.SIGTERM)
        arm.wait()
        print(f"  {log.read_text(encoding='utf-8').splitlines()[-1]}", flush=True)
        time.sleep(2.0)
    arm, observer = emulator(500.0, log), Observer()
    time.sleep(3.0)
    if options.stops:
        print(stops(observer, options.stops), flush=True)
    for both in (False, True):
        print(killed(observer, both), flush=True)
        time.sleep(22.0)  # until nobody knows the dead any more
        driver = create("ros2", ADDRESS)
        driver.connect()
        driver.start("p", driver.upload("p", program(json.dumps(TO) + "\n")))
        read(driver)
        driver.close()
    arm.send_signal(signal.SIGTERM)
    arm.wait()
    log.unlink()
    sys.stdout.flush()
    os._exit(0)  # rclpy may hang at the end


if __name__ == "__main__":
    main()
