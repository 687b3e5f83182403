"""Attacks on an arm on ROS 2 in motion: by other nodes, by signals, and by what a robot should never publish."""

import itertools
import os
import re
import resource
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from functools import partial

import numpy as np
import pytest

from agent.motion import JointTarget, Move, MoveType, create_dialect
from agent.motion.joint_trajectory.settings import PaceSettings
from agent.robot import load_robot
from drivers.wire.ros2 import RosAddress
from fake_controller.ros2.node import JointStateWriter
from fake_controller.state import home
from tests.conftest import patience
from tests.ros2.conftest import CONTROLLER, DOMAIN, JOINTS
from tests.ros2.test_faults import RECIPE, STRIKES

pytestmark = pytest.mark.verify
#: The arm swings out by this much [rad] at this speed [rad/s].
WAY, PACE = 0.9, 0.5
STOPPED = 1.5  # s, after which no stop may still be under way
#: The agent as it is, but for a watchdog that a busy computer needs.
AGENT = """
import functools, sys
from agent.cli import main
from drivers.transports.ros2.driver import Ros2Driver
Ros2Driver.__init__ = functools.partialmethod(Ros2Driver.__init__, watchdog={})
sys.exit(main())
"""


class Scene:
    """An arm, the agent as a process that records a swing of it, and what the arm does meanwhile."""

    def __init__(self, bench, folder, arm):
        self.bench, self.cell, self.server, self.folder = bench, bench.cell, bench.server, folder
        self.trace, self.struck = [], None
        robot, advance = load_robot(arm), self.cell.run

        def noted():
            cycles = advance()
            if cycles is not None:
                self.trace.append((self.cell._clock(), float(np.abs(self.cell.velocity).max())))
            return cycles

        self.cell.run = noted
        pace = PaceSettings(velocity=(PACE, PACE), acceleration=(2.0, 2.0))
        swing = [Move(MoveType.JOINT, JointTarget(home(robot) + WAY * part), pace) for part in (1.0, 0.0) * 2]
        program, recipe = folder / "swing.jsonl", folder / "recipe.yaml"
        program.write_text(create_dialect("joint_trajectory").write("swing", swing, robot), encoding="utf-8")
        recipe.write_text(RECIPE.format(robot=arm, address=bench.address), encoding="utf-8")
        agent = [sys.executable, "-c", AGENT.format(patience(0.5))]
        self.command = [*agent, "record", recipe, "--program", program, "-o", folder / "swing.mcap", "--yes"]

    def start(self, **options):
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        self.agent = subprocess.Popen(self.command, **pipes, **options)
        self.bench.undo.callback(self.agent.kill)

    def wait_until_it_moves(self):
        until = time.monotonic() + patience(40.0)
        while not self.cell._moved > STRIKES and self.agent.poll() is None and time.monotonic() < until:
            time.sleep(0.01)
        assert self.cell._moved > STRIKES, self.agent.communicate()[0]
        self.struck = self.cell._clock()

    def end(self):
        """Exit code and output of the agent; the arm has come to rest."""
        output = self.agent.communicate(timeout=patience(60.0))[0]
        until = time.monotonic() + patience(25.0)
        while self.bench.moving() and time.monotonic() < until:
            time.sleep(0.01)
        assert not self.bench.moving()
        return self.agent.returncode, output

    def stood_after(self):
        moved = [at for at, speed in list(self.trace) if speed > 0.02]
        return max(0.0, moved[-1] - self.struck) if moved else 0.0

    def fastest_after(self):
        return max(speed for at, speed in list(self.trace) if at >= self.struck)

    # Attackers

    def brake_process(self):
        children = subprocess.run(["pgrep", "-P", str(self.agent.pid)], capture_output=True, text=True, check=True)
        return [int(pid) for pid in children.stdout.split()]

    def node(self, name):
        import rclpy

        context = rclpy.Context()
        rclpy.init(context=context, domain_id=DOMAIN, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        node = rclpy.node.Node(name, context=context)
        self.bench.undo.callback(context.try_shutdown)
        self.bench.undo.callback(node.destroy_node)
        return node

    def publish(self, data, rate=100.0, name="joint_state_publisher"):
        """Somebody else on joint_states, with these bytes, or what a function of the time makes."""
        from sensor_msgs.msg import JointState

        topic = RosAddress.of(self.bench.address).name("joint_states")
        self._repeat(self.node(name).create_publisher(JointState, topic, 10).publish, data, rate)

    def command_arm(self, rate, positions=(0.3, 0.3), name="teleop"):
        from builtin_interfaces.msg import Duration
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        topic = RosAddress.of(self.bench.address).name(CONTROLLER, "joint_trajectory")
        point = JointTrajectoryPoint(positions=list(positions), velocities=[0.0, 0.0], time_from_start=Duration(sec=1))
        message = JointTrajectory(joint_names=list(JOINTS), points=[point])
        publisher = self.node(name).create_publisher(JointTrajectory, topic, 10)
        if rate:
            until = time.monotonic() + patience(5.0)
            while publisher.get_subscription_count() == 0 and time.monotonic() < until:
                time.sleep(0.01)
            self._repeat(publisher.publish, lambda now: message, rate)

    def _repeat(self, publish, data, rate):
        over = threading.Event()

        def run():
            while not over.wait(1.0 / rate):
                publish(data(time.time()) if callable(data) else data)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        self.bench.undo.callback(thread.join)
        self.bench.undo.callback(over.set)

    def rewrite(self, change):
        """Each joint state of the arm is changed from now on: `change(writer, stamp, rows)` gives bytes, or None."""
        writers = self.server._writers

        class Changed:
            def write(_, stamp, *rows):
                data = change(writers[0], stamp, rows)
                return writers[1].write(stamp, *(row[:-1] for row in rows)) if data is None else data

        self.server._writers = (Changed(), writers[1])


def joint_state(names, position, stamp=None):
    rows = (np.asarray(position, dtype=float), np.zeros(len(names)), np.zeros(len(names)))
    return JointStateWriter(names).write(time.time() if stamp is None else stamp, *rows)


def permuted(scene):
    rng = np.random.default_rng(0)

    def change(writer, stamp, rows):
        order = rng.permutation(len(JOINTS))
        names = [sorted(JOINTS)[k] for k in order]
        return JointStateWriter(names).write(stamp, *(row[order] for row in rows))

    scene.rewrite(change)


def same(value):
    return value


def changed(scene, stamp=same, position=same, velocity=same, effort=same, names=None):
    def change(writer, at, rows):
        writer = writer if names is None else JointStateWriter(names)
        return writer.write(stamp(at), position(rows[0]), velocity(rows[1]), effort(rows[2]))

    scene.rewrite(change)


def twice(scene):
    names = [*sorted(JOINTS), JOINTS[0]]
    scene.rewrite(lambda _, stamp, rows: JointStateWriter(names).write(stamp, *(np.append(row, 9.0) for row in rows)))


def one(value):
    """One sample only has this value at its first joint."""
    begun = []

    def change(row):
        row = row.copy()
        if not begun:
            row[0] = value
            begun.append(1)
        return row

    return change


def slowly(begun, factor):
    return lambda stamp: begun + factor * (stamp - begun)


def simulated(scene):
    from rclpy.parameter import Parameter

    scene.server._nodes[0].set_parameters([Parameter("use_sim_time", value=True)])
    changed(scene, stamp=slowly(time.time(), 0.5))


def seldom(scene, every=10):
    count = iter(range(10**9))
    publish = scene.server._states.publish

    class Publisher:
        topic = scene.server._states.topic

        @staticmethod
        def publish(data):
            if next(count) % every == 0:
                publish(data)

    scene.server._states = Publisher


def stop_agent_for(scene, seconds):
    scene.agent.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    scene.agent.send_signal(signal.SIGCONT)


def kill_second(scene, number):
    for pid in scene.brake_process():
        os.kill(pid, number)


def many_nodes(scene):
    for k in range(40):
        scene.node(f"other_{k}")


def describe(scene, text):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    topic = RosAddress.of(scene.bench.address).name("robot_description")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = scene.node("describer").create_publisher(String, topic, latched)
    publisher.publish(String(data=text))


def clock_forward(scene, seconds):
    scene.cell._clock_back = -seconds


def command_copies(scene, slower):
    """Somebody sends the trajectory that runs once more, from now on and slower: its path is the same at first."""
    message = scene.server.taken[-1]
    for point in message.points:
        at = slower * (point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec)
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(round(1e9 * at), 10**9)
        point.velocities = [one / slower for one in point.velocities]
        point.accelerations = [one / slower**2 for one in point.accelerations]
    stamp = scene.cell.now()
    message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), int(stamp % 1 * 1e9)
    scene.server.take(message)


def held_back(scene, seconds):
    """Samples come in bursts, `seconds` apart."""
    publish, waiting = scene.server._states.publish, []
    due = [time.monotonic()]

    class Publisher:
        topic = scene.server._states.topic

        @staticmethod
        def publish(data):
            waiting.append(data)
            if time.monotonic() >= due[0]:
                due[0] = time.monotonic() + seconds
                for one in waiting:
                    publish(one)
                waiting.clear()

    scene.server._states = Publisher


def again(scene, change):
    """Every sample is published once more as `change(data)`."""
    publish = scene.server._states.publish

    class Publisher:
        topic = scene.server._states.topic

        @staticmethod
        def publish(data):
            publish(data)
            publish(change(data))

    scene.server._states = Publisher


def frozen(scene):
    """The last message comes again and again, as from a node that hangs in its loop."""
    last = []

    def change(writer, stamp, rows):
        last.append(writer.write(stamp, *rows))
        return last[0]

    scene.rewrite(change)


def jumping(seconds):
    signs = itertools.cycle((1.0, -1.0))
    return lambda stamp: stamp + next(signs) * seconds


def growing(rate):
    """An offset of a position that grows [rad/s], as of an encoder that slips."""
    begun = time.time()
    return lambda q: q + rate * (time.time() - begun)


def delayed(seconds):
    """Positions as they were this time [s] ago; they stand still at first."""
    was = deque()

    def change(q):
        now = time.time()
        was.append((now, q.copy()))
        while len(was) > 1 and was[1][0] <= now - seconds:
            was.popleft()
        return was[0][1]

    return change


def late_and_ahead(scene):
    clock_forward(scene, 0.2)
    changed(scene, position=delayed(0.3))


def noise(size):
    rng = np.random.default_rng(0)
    return lambda q: q + rng.uniform(-size, size, len(q))


def come_and_go(scene, count=8):
    import rclpy

    for k in range(count):
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=DOMAIN, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        rclpy.node.Node(f"guest_{k}", context=context).destroy_node()
        context.try_shutdown()


def cancel_by_others(scene):
    from action_msgs.srv import CancelGoal

    node = scene.node("canceller")
    client = node.create_client(CancelGoal, f"{RosAddress.of(scene.bench.address).action}/_action/cancel_goal")
    client.wait_for_service(patience(5.0))
    client.call_async(CancelGoal.Request())


def take_by_hand(scene, *positions, joints=JOINTS, ends_fast=False):
    """A message that a careless client sends: the controller refuses what is none."""
    from builtin_interfaces.msg import Duration
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    points = [
        JointTrajectoryPoint(
            positions=list(row), velocities=[float(ends_fast)] * len(row), time_from_start=Duration(sec=1 + k)
        )
        for k, row in enumerate(positions)
    ]
    scene.server.take(JointTrajectory(joint_names=list(joints), points=points))


def second_agent(scene):
    """Another agent, which shares no lock with the first, as on another computer."""
    home_of_second = scene.folder / "other_home"
    home_of_second.mkdir()
    command = [*scene.command]
    command[command.index("-o") + 1] = scene.folder / "second.mcap"
    ended = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=home_of_second,
        env={**os.environ, "HOME": str(home_of_second), "XDG_STATE_HOME": str(home_of_second)},
    )  # fmt: skip
    assert ended.returncode in (4, 75), ended.stdout + ended.stderr


def kill_both(scene):
    second = scene.brake_process()
    scene.agent.kill()
    for pid in second:
        os.kill(pid, signal.SIGKILL)


def stop_then_kill(scene):
    scene.agent.send_signal(signal.SIGSTOP)
    time.sleep(0.2)
    scene.agent.kill()


def stop_for_good(scene):
    scene.agent.send_signal(signal.SIGSTOP)
    until = time.monotonic() + patience(20.0)
    while scene.bench.moving() and time.monotonic() < until:
        time.sleep(0.01)
    scene.agent.kill()


def whole(sec, nanosec):
    """Every stamp is this."""
    return lambda data: data[:4] + struct.pack("<iI", sec, nanosec) + data[12:]


def bytes_changed(scene, change):
    publish = scene.server._states.publish

    class Publisher:
        topic = scene.server._states.topic

        @staticmethod
        def publish(data):
            publish(change(data))

    scene.server._states = Publisher


def small_disk():
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))


HEADER = b"\x00\x01\x00\x00"
#: Before the start: attack, exit code, what is said. Nothing moves where that is not 0.
BEFORE = {
    "joints in another order in each message": (permuted, 0, ""),
    "another arm publishes the same joints": (
        lambda s: s.publish(lambda now: joint_state(JOINTS, (1.0, 1.0), now)), 4, "a joint jumps by .* second node",
    ),
    "stamps are zero": (partial(changed, stamp=lambda at: 0.0), 4, "stamps .* stand still"),
    "simulated time at half speed": (simulated, 4, "loses .* s in each"),
    "a clock 5 % too slow": (lambda s: changed(s, stamp=slowly(time.time(), 0.95)), 4, r"loses 0.0[45]\d* s in each"),
    "a clock 5 % too fast": (lambda s: changed(s, stamp=slowly(time.time(), 1.05)), 4, r"gains 0.0[45]\d* s in each"),
    "velocities in degrees": (partial(changed, velocity=np.degrees), 5, "cannot be trusted"),
    "somebody else can command": (lambda s: s.command_arm(0), 4, "/teleop can command"),
    "40 more nodes": (many_nodes, 0, ""),
    "other joints at 500 Hz": (lambda s: s.publish(joint_state(("finger", "thumb"), (1.0, 2.0)), 500.0), 0, ""),
    "a description of 20 MB": (lambda s: describe(s, "<robot name='big'>" + "x" * 20_000_000), 4, "than 16|two descr"),
    "a description of a million tags": (lambda s: describe(s, "<robot " * 1_000_000), 4, "no <robot name|two descr"),
    "a joint twice in each message": (twice, 4, "a joint twice"),
    "efforts are no numbers": (partial(changed, effort=lambda e: np.full_like(e, np.nan)), (3, 4, 5), "effort"),
    "efforts without gravity": (lambda s: setattr(s.cell, "effort", "compensated"), (3, 4, 5), "gravity|effort"),
    "positions are no numbers": (partial(changed, position=lambda q: np.full_like(q, np.nan)), 4, "no sample|numbers"),
    "samples in bursts of 0.6 s": (lambda s: held_back(s, patience(0.6)), 4, "late|samples every"),
    "a description of another robot": (lambda s: describe(s, "<robot name='other'/>"), 4, "other"),
    "the arm moves already": (lambda s: s.command_arm(2.0, (0.6, 0.6)), 4, "can command|moves already"),
    "the controller is gone": (lambda s: s.server.close(), 4, "no node .* answers|silent|no sample"),
    "a stamp beyond its range": (lambda s: bytes_changed(s, whole(7, 4_000_000_000)), 4, "stand still"),
    "the last stamp of all": (lambda s: bytes_changed(s, whole(2**31 - 1, 999_999_999)), 4, "stand still"),
    "big-endian messages": (lambda s: bytes_changed(s, lambda d: b"\0\0" + d[2:]), 4, "damaged|little-endian"),
    "a list of 4 billion numbers": (
        lambda s: bytes_changed(s, lambda d: d.replace(struct.pack("<I", 2), b"\xff" * 4)), 4, "damaged|another type",
    ),
    "speed at 50 %": (lambda s: setattr(s.cell.controller, "scaling", 0.5), 5, ""),
}  # fmt: skip
#: In motion: attack, exit code, what is said, how soon the arm stands [s].
DURING = {
    "joints in another order": (permuted, 0, "", 99),
    "joints get another name": (partial(changed, names=["left_elbow", "left_shoulder"]), 4, "fell silent", STOPPED),
    "one position is no number": (partial(changed, position=one(np.nan)), 5, "no numbers", STOPPED),
    "one position is infinite": (partial(changed, position=one(np.inf)), 5, "no numbers|jumps by inf", STOPPED),
    "positions are no numbers": (partial(changed, position=lambda q: np.full_like(q, np.nan)), (4, 5), "", STOPPED),
    "efforts end": (partial(changed, effort=lambda e: np.full_like(e, np.nan)), 5, "", STOPPED),
    "velocities are absurd": (partial(changed, velocity=lambda v: v * 1e6), (0, 3, 5), "", 99),
    "another arm publishes the same joints": (
        lambda s: s.publish(lambda now: joint_state(JOINTS, (0.0, 0.0), now)), 5, "a joint jumps by", STOPPED,
    ),
    "the same by another clock": (lambda s: s.publish(joint_state(JOINTS, (0.0, 0.0), 5.0)), 5, "", STOPPED),
    "stamps turn to zero": (partial(changed, stamp=lambda at: 0.0), 4, "", STOPPED + 0.5),
    "clock an hour ahead": (partial(clock_forward, seconds=3600.0), (4, 5), "", STOPPED + 0.5),
    "clock half a second ahead": (partial(clock_forward, seconds=0.5), (4, 5), "", STOPPED),
    "clock 0.2 s ahead": (partial(clock_forward, seconds=0.2), 5, "", STOPPED),
    "positions 0.3 s behind": (partial(changed, position=delayed(0.3)), 5, "", STOPPED),
    "positions 0.15 s behind": (partial(changed, position=delayed(0.15)), (0, 5), "", STOPPED + 0.5),
    "clock 0.2 s ahead, positions 0.3 s behind": (late_and_ahead, 5, "", STOPPED),
    "a clock 5 % too slow": (lambda s: changed(s, stamp=slowly(time.time(), 0.95)), 5, "off its trajectory", 6.0),
    "stamps run at half speed": (lambda s: changed(s, stamp=slowly(time.time(), 0.5)), (4, 5), "", 3.0),
    "another trajectory": (lambda s: s.command_arm(0.5), 5, "trajectory|path|plan", 6.0),
    "another trajectory 50 times a second": (lambda s: s.command_arm(50.0), 5, "", 30.0),
    "50 samples a second": (seldom, (0, 3, 4), "", 99),
    "the second process is killed": (partial(kill_second, number=signal.SIGKILL), 4, "second process", STOPPED),
    "the agent stands for 3 s": (partial(stop_agent_for, seconds=3.0), (4, 5), "", 1.0 + STOPPED),
    "the agent stands for 0.4 s": (partial(stop_agent_for, seconds=0.4), (0, 4), "", 99),
    "the agent is killed": (lambda s: s.agent.kill(), -9, "", STOPPED),
    "the terminal hangs up": (lambda s: s.agent.send_signal(signal.SIGHUP), 129, "", STOPPED),
    "Ctrl-C": (lambda s: s.agent.send_signal(signal.SIGINT), 130, "", STOPPED),
    "random bytes on joint_states": (lambda s: s.publish(HEADER + os.urandom(200)), 4, "damaged|another type", STOPPED),
    "a message of four bytes": (lambda s: s.publish(HEADER), 4, "damaged|another type", STOPPED),
    "speed sinks to 30 %": (lambda s: setattr(s.cell.controller, "scaling", 0.3), 5, "trajectory|path|plan", STOPPED),
    "what was sent comes again": (lambda s: s.bench.replay(), 0, "", 99),
    "the same message again and again": (frozen, 4, "fell silent|stand still", STOPPED),
    "stamps two seconds old": (partial(changed, stamp=lambda at: at - 2.0), (4, 5), "", STOPPED),
    "stamps jump to and fro by 0.3 s": (partial(changed, stamp=jumping(0.3)), (4, 5), "", STOPPED),
    "stamps jump to and fro by 2 s": (partial(changed, stamp=jumping(2.0)), (4, 5), "", STOPPED),
    "stamps run twice as fast": (lambda s: changed(s, stamp=slowly(time.time(), 2.0)), (4, 5), "", STOPPED),
    "joints have each other's names": (partial(changed, names=sorted(JOINTS, reverse=True)), (0, 5), "", 99),
    "a position 0.2 rad off once": (partial(changed, position=one(0.2)), (4, 5), "", STOPPED),
    "positions slip by 0.1 rad/s": (lambda s: changed(s, position=growing(0.1)), 5, "", 2.5),
    "positions with noise of 0.02 rad": (partial(changed, position=noise(0.02)), (0, 5), "", 99),
    "positions with noise of 0.2 rad": (partial(changed, position=noise(0.2)), 5, "", STOPPED),
    "velocities end": (partial(changed, velocity=lambda v: np.full_like(v, np.nan)), (0, 5), "", 99),
    "efforts are infinite": (partial(changed, effort=lambda e: np.full_like(e, np.inf)), 5, "", STOPPED),
    "efforts turn round": (partial(changed, effort=lambda e: -e), (0, 5), "", 99),
    "no positions in the messages": (partial(changed, position=lambda q: q[:0]), (4, 5), "", STOPPED),
    "one position too few": (partial(changed, position=lambda q: q[:1]), 4, "", STOPPED),
    "a stamp beyond its range": (lambda s: bytes_changed(s, whole(7, 4_000_000_000)), (4, 5), "", STOPPED),
    "a negative stamp": (lambda s: bytes_changed(s, whole(-5, 0)), (4, 5), "", STOPPED),
    "a list of 4 billion numbers": (
        lambda s: bytes_changed(s, lambda d: d.replace(struct.pack("<I", 2), b"\xff" * 4)), 4, "damaged", STOPPED,
    ),
    "each message cut in half": (lambda s: bytes_changed(s, lambda d: d[: len(d) // 2]), 4, "damaged", STOPPED),
    "a hundred bytes too many": (lambda s: bytes_changed(s, lambda d: d + bytes(100)), (0, 4), "", 99),
    "each message twice": (lambda s: again(s, lambda data: data), 0, "", 99),
    "each message, and an old one": (lambda s: again(s, whole(int(time.time()) - 30, 0)), (4, 5), "", STOPPED),
    "samples in bursts of 0.3 s": (partial(held_back, seconds=0.3), (0, 4), "", 99),
    "samples in bursts of 1 s": (lambda s: held_back(s, patience(1.0)), 4, "late|silent", STOPPED + 0.5),
    "a message of 250 joints, 200 times a second": (
        lambda s: s.publish(joint_state([f"j{k}" for k in range(250)], np.zeros(250)), 200.0), (0, 4), "", 99,
    ),
    "a message of 100 000 joints": (
        lambda s: s.publish(joint_state([f"j{k}" for k in range(100_000)], np.zeros(100_000)), 5.0), 4, "", STOPPED,
    ),
    "the controller's node is gone": (lambda s: s.server.context.try_shutdown(), 4, "silent", 6.0),
    "the controller is deactivated": (lambda s: s.cell.controller.deactivate(), 5, "", STOPPED),
    "speed 0": (lambda s: setattr(s.cell.controller, "scaling", 0.0), 5, "", STOPPED),
    "speed 150 %": (lambda s: setattr(s.cell.controller, "scaling", 1.5), 5, "", STOPPED),
    "the same trajectory slower": (partial(command_copies, slower=1.5), 5, "", 30.0),
    "an empty trajectory": (take_by_hand, 0, "", 99),
    "a trajectory of other joints": (partial(take_by_hand, joints=("x", "y")), 0, "", 99),
    "a trajectory of NaN": (lambda s: take_by_hand(s, (np.nan, np.nan)), 0, "", 99),
    "a trajectory that ends fast": (lambda s: take_by_hand(s, (0.3, 0.3), ends_fast=True), 0, "", 99),
    "somebody cancels": (cancel_by_others, 0, "", 99),
    "nodes come and go": (come_and_go, (0, 4), "", 99),
    "another description": (lambda s: describe(s, "<robot name='other'/>"), 0, "", 99),
    "a second agent": (second_agent, 0, "", 99),
    "agent and second process are killed": (kill_both, -9, "", 5.0),
    "the agent is stopped, then killed": (stop_then_kill, -9, "", STOPPED),
    "the agent is stopped for good": (stop_for_good, -9, "", 1.0 + STOPPED),
    "the second process is stopped": (partial(kill_second, number=signal.SIGSTOP), 4, "second process", 2.0 + STOPPED),
    "the second process is told to end": (partial(kill_second, number=signal.SIGTERM), 0, "", 99),
    "the log is deleted": (lambda s: (s.folder / "swing.mcap").unlink(), 1, "", STOPPED + 1.0),
    "SIGQUIT": (lambda s: s.agent.send_signal(signal.SIGQUIT), 131, "", STOPPED),
    "SIGTERM": (lambda s: s.agent.send_signal(signal.SIGTERM), 143, "", STOPPED),
    "Ctrl-C twice": (
        lambda s: (s.agent.send_signal(signal.SIGINT), time.sleep(0.1), s.agent.send_signal(signal.SIGINT)),
        130, "", STOPPED,
    ),
}  # fmt: skip


@pytest.fixture
def scene(ros_bench, arm, tmp_path):
    return Scene(ros_bench(), tmp_path, arm)


@pytest.mark.parametrize("name", BEFORE)
def test_before_the_start(scene, measured, name):
    attack, code, said = BEFORE[name]
    attack(scene)
    scene.start()
    ended, output = scene.end()
    codes = code if isinstance(code, tuple) else (code,)
    measured(f"ros2, before the start: {name}: exit code", str(ended), "", "", ended in codes)
    print(f"{name}: exit {ended}\n{output[-900:]}")
    assert "Traceback" not in output
    assert ended in codes, output
    assert re.search(said, output), output
    assert scene.bench.motions_started() == 0 or ended in (0, 5) or "moves already" in name


@pytest.mark.parametrize("name", DURING)
def test_in_motion(scene, measured, name):
    attack, code, said, soon = DURING[name]
    scene.start()
    scene.wait_until_it_moves()
    attack(scene)
    ended, output = scene.end()
    took, fastest = scene.stood_after(), scene.fastest_after()
    measured(f"ros2, in motion: {name}: exit code, stationary after", f"{ended}, {took:.2f} s", "", "", True)
    print(f"{name}: exit {ended}, stood after {took:.2f} s, at most {fastest:.2f} rad/s\n{output[-900:]}")
    assert "Traceback" not in output
    assert ended in (code if isinstance(code, tuple) else (code,)), output
    assert re.search(said, output), output
    assert took <= patience(soon)
    if re.search("ahead|behind", name) and "does not obey" in output:
        assert "what is seen of it may be late" in output
    if not re.search("ahead|trajectory|150 %", name):  # there the controller itself is faster
        assert fastest <= 1.6 * PACE, "the stop threw the arm"
    assert scene.bench.motions_started() <= 4


def test_a_full_disk_stops_the_arm(scene, measured):
    scene.start(preexec_fn=small_disk)
    ended, output = scene.end()
    assert ended == 1, output
    assert "Traceback" not in output
    assert not scene.bench.moving()
