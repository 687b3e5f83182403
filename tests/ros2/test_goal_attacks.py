"""Attacks on goals: an action server that refuses, forgets, contradicts itself, or serves somebody else.

With unmodified rclpy on both ends, and control_msgs or what stands for it (`conftest.goal_types`).
"""

import re
import signal
import time
from functools import partial

import pytest

from drivers.wire.ros2 import RosAddress
from fake_controller.ros2.controller import ErrorCode
from tests.conftest import patience
from tests.ros2.conftest import JOINTS
from tests.ros2.test_attacks import PACE, STOPPED, Scene, cancel_by_others

pytestmark = pytest.mark.verify


class GoalScene(Scene):
    """Goals that came to the server are counted, whatever becomes of them."""

    def __init__(self, bench, folder, arm):
        super().__init__(bench, folder, arm)
        self.action, self.offered = bench.server._action, []
        self._answer = self.action._goal_callback
        self.action.register_goal_callback(self._offer)

    def _offer(self, goal):
        self.offered.append(goal)
        return self._answer(goal)

    def answer_by(self, answer):
        """`answer(goal, usual)` is the server's answer from now on."""
        usual = self._answer
        self._answer = lambda goal: answer(goal, usual)

    def client(self, name="another_client"):
        from control_msgs.action import FollowJointTrajectory
        from rclpy.action import ActionClient

        client = ActionClient(self.node(name), FollowJointTrajectory, RosAddress.of(self.bench.address).action)
        assert client.wait_for_server(patience(5.0))
        self.bench.undo.callback(client.destroy)
        return client


def refuse(scene):
    from rclpy.action import GoalResponse

    scene.answer_by(lambda goal, usual: GoalResponse.REJECT)


def refuse_second(scene):
    from rclpy.action import GoalResponse

    scene.answer_by(lambda goal, usual: GoalResponse.REJECT if len(scene.offered) > 1 else usual(goal))


def answer_late(scene, seconds):
    def answer(goal, usual):
        time.sleep(seconds)  # and so nothing else is heard meanwhile
        return usual(goal)

    scene.answer_by(answer)


def forget_answers(scene):
    """The goal runs, and feedback comes."""
    from control_msgs.action import FollowJointTrajectory

    scene.action._handle = Without(scene.action._handle, "send_goal_response")
    execute = scene.action._execute_callback

    async def run(handle):
        for _ in range(20):
            handle.publish_feedback(FollowJointTrajectory.Feedback())
        return await execute(handle)

    scene.action.register_execute_callback(run)


class Without:
    """Something whose method does nothing, or what is given."""

    def __init__(self, whole, name, instead=lambda *_: None):
        self._whole, self._name, self._instead = whole, name, instead

    def __getattr__(self, name):
        return self._instead if name == self._name else getattr(self._whole, name)

    def __enter__(self):
        return self._whole.__enter__()

    def __exit__(self, *error):
        return self._whole.__exit__(*error)


def forget_results(scene):
    scene.action._handle = Without(scene.action._handle, "send_result_response")


def answer_results(scene, *ends):
    """Each result is sent with these codes and texts, one after the other."""
    from control_msgs.action import FollowJointTrajectory

    whole = scene.action._handle

    def send(header, response):
        for code, text in ends:
            response.result = FollowJointTrajectory.Result(error_code=code, error_string=text)
            whole.send_result_response(header, response)

    scene.action._handle = Without(whole, "send_result_response", send)


def end_goal(scene, status="aborted", code=ErrorCode.PATH_TOLERANCE_VIOLATED, text="left its path"):
    controller = scene.cell.controller
    with controller._lock:
        controller._end(status, code, text)
        controller._hold()


def succeed_early(scene):
    """The controller says that the goal was reached, and goes on with it."""
    controller = scene.cell.controller
    with controller._lock:
        controller._end("succeeded", ErrorCode.SUCCESSFUL, "reached")


def refuse_cancels(scene):
    from rclpy.action import CancelResponse

    scene.action.register_cancel_callback(lambda handle: CancelResponse.REJECT)


def interrupt(scene):
    scene.agent.send_signal(signal.SIGINT)


def send_another(scene):
    from builtin_interfaces.msg import Duration
    from control_msgs.action import FollowJointTrajectory
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    point = JointTrajectoryPoint(positions=[0.3, 0.3], velocities=[0.0, 0.0], time_from_start=Duration(sec=3))
    goal = FollowJointTrajectory.Goal(trajectory=JointTrajectory(joint_names=list(JOINTS), points=[point]))
    client = scene.client()
    scene.struck = scene.cell._clock()
    client.send_goal_async(goal)


def cancel(scene):
    """By an empty request, as a pendant sends it."""
    cancel_by_others(scene)
    scene.struck = scene.cell._clock()


def nothing(scene):
    return None


#: Before the start: attack, exit code, what is said, goals that came to the server.
BEFORE = {
    "a goal is refused": (refuse, 4, "refused a trajectory", 1),
    "the second goal is refused": (refuse_second, 4, "refused a trajectory", 2),
    "goals are answered after 0.2 s": (partial(answer_late, seconds=0.2), 0, "", 4),
    "goals are answered after 3 s": (partial(answer_late, seconds=3.0), 4, "did not answer a goal within", 1),
    "no goal is answered, and feedback comes": (forget_answers, 4, "did not answer a goal within", 1),
    "no result comes": (forget_results, 4, "the controller says nothing of it", 1),
    "each result comes twice": (lambda s: answer_results(s, (0, "done"), (-4, "left its path")), 0, "", 4),
    "results contradict each other": (
        lambda s: answer_results(s, (-5, "not reached"), (0, "done")), 5, "did not reach the end in time", 1,
    ),
    "an unknown error": (lambda s: answer_results(s, (-77, "")), 5, "error -77", 1),
    "an error with a text that is none": (
        lambda s: answer_results(s, (-77, "\x1b[31m\x07" + "x" * 100_000 + "\ny")), 5, "error -77", 1,
    ),
}  # fmt: skip
#: In motion: attack, exit code, what is said, how soon the arm stands [s].
DURING = {
    "nothing": (nothing, 0, "", 99),
    "path tolerance": (end_goal, 5, "left its path by more than the tolerance", STOPPED),
    "goal tolerance": (
        partial(end_goal, code=ErrorCode.GOAL_TOLERANCE_VIOLATED), 5, "did not reach the end in time", STOPPED,
    ),
    "another client's goal": (send_another, 5, "another client.s goal replaced it", STOPPED),
    "somebody cancels": (cancel, 5, "somebody cancelled it", STOPPED),
    "success too early": (succeed_early, 0, "", 99),
    "success, and the arm stands": (
        partial(end_goal, status="succeeded", code=ErrorCode.SUCCESSFUL), 5, "off its trajectory|stand still", STOPPED,
    ),
    "the action server is gone": (lambda s: s.action.destroy(), 4, "the controller says nothing of it", 10.0),
    "Ctrl-C, cancel refused": (lambda s: (refuse_cancels(s), interrupt(s)), 130, "", STOPPED),
    "the agent is killed": (lambda s: s.agent.kill(), -9, "", STOPPED),
    "the agent is killed, cancel refused": (lambda s: (refuse_cancels(s), s.agent.kill()), -9, "", STOPPED),
}  # fmt: skip


@pytest.fixture
def scene(goal_types, ros_bench, arm, tmp_path):
    return GoalScene(ros_bench(goals=True), tmp_path, arm)


def check(scene, name, measured, codes, said):
    ended, output = scene.end()
    took = scene.stood_after() if scene.struck else 0.0
    print(f"{name}: exit {ended}, stood after {took:.2f} s, {len(scene.offered)} goals\n{output[-1200:]}")
    measured(f"ros2, goals: {name}: exit code, stationary after", f"{ended}, {took:.2f} s", "", "", True)
    assert "Traceback" not in output
    assert ended in (codes if isinstance(codes, tuple) else (codes,)), output
    assert re.search(said, output), output
    assert all(char.isprintable() or char == "\n" for char in output)
    assert len(output) < 5000
    assert (scene.folder / "swing.mcap").exists()
    stamps = {(goal.trajectory.header.stamp.sec, goal.trajectory.header.stamp.nanosec) for goal in scene.offered}
    assert len(stamps) == len(scene.offered), "a goal came twice"
    return took


@pytest.mark.parametrize("name", BEFORE)
def test_before_the_start(scene, measured, name):
    attack, code, said, goals = BEFORE[name]
    attack(scene)
    scene.start()
    check(scene, name, measured, code, said)
    assert len(scene.offered) == goals
    assert scene.bench.motions_started() <= goals


@pytest.mark.parametrize("name", DURING)
def test_in_motion(scene, measured, name):
    attack, code, said, soon = DURING[name]
    scene.start()
    scene.wait_until_it_moves()
    attack(scene)
    took = check(scene, name, measured, code, said)
    assert took <= patience(soon)
    assert scene.fastest_after() <= 1.6 * PACE, "the stop threw the arm"
    assert len(scene.offered) == 4 or code != 0
