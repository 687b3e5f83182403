import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.core import InProcess, InputError, LocalProcesses
from agent.excitation import Candidates, LoopProblem, check_sub_region, search
from agent.excitation.loop_search import Generation
from agent.motion import ViaRegions
from agent.robot import Box, Tool


@pytest.fixture(scope="module")
def candidates(problem: LoopProblem) -> Candidates:
    return Candidates(problem)


def genomes(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((count, 36))


def test_a_seed_gives_the_same_loop_for_any_number_of_workers(problem: LoopProblem) -> None:
    told: list[list[Generation]] = [[], []]
    one = search(problem, population=8, generations=3, seed=4, engine=InProcess(), progress=told[0].append)
    with LocalProcesses(2) as engine:
        two = search(problem, population=8, generations=3, seed=4, engine=engine, progress=told[1].append)
    assert one.loop.genome.tobytes() == two.loop.genome.tobytes()
    assert one.fitness == two.fitness
    assert one.to_dict() == two.to_dict()
    assert told[0] == told[1]
    assert [generation.number for generation in told[0]] == [0, 1, 2]
    np.testing.assert_array_equal(one.loop.trajectory.q, two.loop.trajectory.q)


def test_the_result_is_the_best_of_the_finalists_on_all_samples(problem: LoopProblem, candidates: Candidates) -> None:
    result = search(problem, method="random", population=7, generations=2, seed=2, engine=InProcess())
    assert result.evaluated == 14
    assert len(result.generations) == 2
    assert result.finalists.shape == (10, 2)
    assert result.finalists[0, 0] == np.nanmax([generation.best for generation in result.generations])
    assert (np.diff(result.finalists[:, 0]) <= 0).all()
    assert result.fitness == result.finalists[:, 1].max()
    assert result.fitness == pytest.approx(candidates.score_on_all(result.loop.genome).fitness, abs=1e-9)
    assert len(result.columns) == 58


def test_a_loop_starts_and_ends_stationary_at_its_first_point(candidates: Candidates) -> None:
    for genome in genomes(5):
        loop = candidates.loop(genome)
        np.testing.assert_allclose(loop.poses, candidates.problem.regions.poses(genome))
        np.testing.assert_allclose(candidates.kinematics.forward(loop.start[None])[0], loop.poses[0], atol=1e-9)
        np.testing.assert_allclose(loop.trajectory.q[[0, -1]], [loop.start, loop.start], atol=1e-6)
        np.testing.assert_allclose(loop.trajectory.qd[[0, -1]], 0.0, atol=1e-9)


def test_a_loop_starts_on_the_branch_of_the_sub_region_centre(candidates: Candidates) -> None:
    """Where the wrist's other branch is nearer; hoses hang there as they never do at work."""
    genome = np.full((6, 6), 0.5)
    genome[0] = 0, 0, 0, 1, 0, 0
    genome[1:, :3] = np.random.default_rng(0).random((5, 3))
    kinematics = candidates.kinematics
    usual = kinematics.configuration(candidates.posture).signs
    loop = candidates.loop(genome.ravel())
    assert kinematics.configuration(kinematics.solve(loop.poses[0], candidates.posture)).signs != usual
    assert kinematics.configuration(loop.start).signs == usual


def test_every_tenth_sample_is_enough_for_the_regressor(candidates: Candidates) -> None:
    for genome in genomes(5, seed=1):
        tenth, every = candidates.score(genome), candidates.score_on_all(genome)
        assert tenth.feasible
        assert tenth.fitness == pytest.approx(every.fitness, abs=0.5)


def test_a_batch_of_loops_equals_single_evaluation(problem_with: Any) -> None:
    """To the bit, among them some that start out of reach, that cannot be run and that have a point out of reach."""
    candidates = Candidates(problem_with((1.25, 0.0, 0.8), (0.8, 0.8, 0.5)))
    drawn = genomes(8, seed=1)
    together = candidates.loops(drawn)
    assert len({type(loop) for loop in together}) == 3
    for genome, loop in zip(drawn, together, strict=True):
        if isinstance(loop, InputError):
            with pytest.raises(type(loop), match=re.escape(str(loop))):
                candidates.loop(genome)
        else:
            assert np.array_equal(candidates.loop(genome).trajectory.q, loop.trajectory.q)
    assert candidates.scores(drawn) == [candidates.score(genome) for genome in drawn]


def test_a_loop_out_of_reach_is_infeasible_by_how_far(problem_with: Any) -> None:
    near, far = (Candidates(problem_with((x, 0.0, 0.8))) for x in (1.45, 1.6))
    genome = np.full(36, 0.5)
    genome[6:9] = 1.0
    scores = [candidates.score(genome) for candidates in (near, far)]
    assert not any(score.feasible for score in scores)
    assert 0 < scores[0].excess < scores[1].excess
    assert "reach" in scores[1].reason


def test_a_loop_whose_blend_misses_a_point_is_infeasible(problem: LoopProblem) -> None:
    """The way of the arm keeps within reach, the target that the controller is given does not."""
    points = [(1.1, 0.3, 0.8, 0.0, 2.0, 0.0), (1.752, 0.0, 0.8, 0.0, 2.0, 0.0), (1.1, -0.3, 0.8, 0.0, 2.0, 0.0)]
    regions = ViaRegions.from_points(points, np.full((3, 6), 1e-6))
    wide = problem.settings.changed(fly_distance=0.08)
    score = Candidates(replace(problem, regions=regions, settings=wide)).score(np.full(18, 0.5))
    assert not score.feasible
    assert "out of reach" in score.reason


def test_a_loop_that_overloads_a_motor_is_infeasible(problem: LoopProblem, problem_with: Any) -> None:
    joints = list(problem.robot.joints)
    joints[1] = replace(joints[1], max_torque=100.0)
    weak = Candidates(problem_with(robot=replace(problem.robot, joints=tuple(joints))))
    score = weak.score(genomes(1)[0])
    assert not score.feasible
    assert "joint_2" in score.reason
    assert "100 N·m" in score.reason


def test_a_loop_through_a_keep_out_box_is_infeasible(problem_with: Any) -> None:
    post = Box("post", (0.9, -0.1, 0.0), (1.1, 0.1, 1.5))
    score = Candidates(problem_with(keep_out=(post,))).score(genomes(1)[0])
    assert not score.feasible
    assert "post" in score.reason


def test_a_loop_beyond_a_cable_is_infeasible(problem_with: Any) -> None:
    genome = genomes(1)[0]
    reached = Candidates(problem_with()).loop(genome).trajectory.q[:, 3]
    short = {"joint_4": (reached.min() - 0.1, reached.max() - 0.01)}
    score = Candidates(problem_with(joint_ranges=short)).score(genome)
    assert not score.feasible
    assert "joint_4" in score.reason
    long = {"joint_4": (reached.min() - 0.1, reached.max() + 0.1)}
    assert Candidates(problem_with(joint_ranges=long)).score(genome).feasible


def test_a_loop_that_winds_the_wrist_up_is_infeasible(candidates: Candidates) -> None:
    """Every move of it keeps the limits, and the tool comes back to where it began, with joints 4 and 6 a turn away."""
    points = [
        [0.8, 0.5, 0.3, 0.9, 0.9, 0.2],
        [1.0, 0.1, 0.1, 0.4, 0.9, 0.9],
        [0.0, 1.0, 0.0, 0.9, 0.1, 0.5],
        [0.2, 0.3, 0.0, 0.1, 0.0, 0.7],
        [0.2, 0.4, 0.7, 0.3, 0.9, 0.2],
        [0.2, 0.2, 0.1, 1.0, 0.4, 0.4],
    ]
    genome = np.ravel(points)
    q = candidates.loop(genome).trajectory.q
    assert np.allclose(np.abs(q[-1] - q[0]), [0, 0, 0, 2 * np.pi, 0, 2 * np.pi], atol=1e-6)
    score = candidates.score(genome)
    assert not score.feasible
    assert "360 deg from where it began" in score.reason


def test_reports_the_nearest_miss_if_no_loop_is_feasible(problem_with: Any) -> None:
    everywhere = Box("everything", (0.6, -1.0, 0.4), (1.6, 1.0, 1.4))  # around the sub-region, clear of the base
    with pytest.raises(InputError, match="everything") as error:
        search(problem_with(keep_out=(everywhere,)), population=4, generations=2, engine=InProcess())
    assert "none of" in str(error.value)


def test_an_unknown_method_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match="genetic, random"):
        search(None, method="guess")  # type: ignore[arg-type]


def test_the_quickstarts_sub_region_is_within_reach(problem: LoopProblem) -> None:
    assert check_sub_region(problem) == []


def test_a_sub_region_out_of_reach_names_point_and_amount(problem_with: Any) -> None:
    with pytest.raises(
        InputError, match=r"via-point 1, middle of its region: .*2\.721 m.*1\.351 m.*via_points"
    ) as error:
        check_sub_region(problem_with((3.0, 0.0, 0.8)))
    assert len(str(error.value).splitlines()) == 1


def test_advises_an_orientation_for_a_tool_frame_with_x_forward(problem_with: Any) -> None:
    tool = Tool(np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]]))
    place = ((0.8, 0.0, 0.3), (0.1, 0.1, 0.1))
    with pytest.raises(InputError, match="the arm's last axis points") as error:
        check_sub_region(problem_with(*place, tool=tool))
    found = re.search(r"orientation (\S+) deg, (\S+) deg, (\S+) deg", str(error.value))
    assert found
    turn = tuple(math.radians(float(angle)) for angle in found.groups())
    regions = ViaRegions.from_box(6, *place, turn, math.radians(30))
    assert check_sub_region(problem_with(tool=tool, regions=regions)) == []


def test_warns_of_a_corner_out_of_reach(problem_with: Any) -> None:
    missed = check_sub_region(problem_with((1.35, 0.0, 0.8)))
    assert missed
    assert all("corner +x" in place.place for place in missed)
    assert {place.point for place in missed} == set(range(6))
    assert "out of reach" in str(missed[0])
