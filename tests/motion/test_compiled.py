"""The compiled loops against what they are defined by, and where their code is kept."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.interpolate import CubicSpline, PPoly
from scipy.spatial.transform import Rotation

from agent.compiled import (
    derivatives,
    evaluate_spline,
    fastest_profile,
    lower_ceiling,
    moving_average_law,
    not_a_knot,
    tcp_rates,
    time_law,
    time_stretch_factors,
    widen_dips,
)
from tests.conftest import loaded

SEEDS = st.integers(0, 2**31)


def constraints_kept(z: np.ndarray, ceiling: np.ndarray, weight: np.ndarray, sums: Any, least: np.ndarray) -> bool:
    rising, falling = sums
    y = np.where(weight * ceiling > least[:, None], weight * z, 0.0)
    limited = weight * ceiling > least[:, None]
    both = limited[:, 1:] & limited[:, :-1]
    slack = 1e-9 * y.max()
    up = y[:, 1:] - y[:, :-1] <= np.diff(rising) + slack
    down = y[:, :-1] - y[:, 1:] <= np.diff(falling) + slack
    return bool(np.all(z <= ceiling) and np.all((up & down) | ~both))


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(1, 4), st.integers(3, 30))
def test_the_fastest_profile_is_feasible_and_optimal_at_every_knot(seed: int, rows: int, knots: int) -> None:
    rng = np.random.default_rng(seed)
    ceiling, weight = rng.uniform(0.1, 2.0, knots), rng.uniform(0.0, 1.0, (rows, knots)) ** 3
    sums = [np.cumsum(rng.uniform(0.0, 0.3, (rows, knots)) * np.r_[0.0, np.ones(knots - 1)], axis=1) for _ in "ud"]
    least = np.full(rows, 1e-4)
    z = fastest_profile(ceiling, weight, *sums, least, 10_000)
    assert z[0] == z[-1] == 0.0
    close = 2e-4 * z.max() * np.arange(knots)  # passes end once z changes by 1e-4 of its largest, above the limits
    assert constraints_kept(0.999 * z, ceiling, weight, [1.002 * part + close for part in sums], least)
    again = np.append(np.append(0.0, ceiling[1:-1]), 0.0)
    for _ in range(2000):  # one limit at a time, until none lowers anything
        before = again.copy()
        for w, up, down, small in zip(weight, *sums, least, strict=True):
            limited = w * ceiling > small
            for order, part in ((range(1, knots), up), (range(knots - 2, -1, -1), down)):
                reached = w * again
                for k in order:
                    other = k - 1 if part is up else k + 1
                    reached[k] = min(reached[k], reached[other] + abs(part[k] - part[other]))
                again = np.where(limited, np.minimum(again, reached / np.where(limited, w, 1.0)), again)
        if np.array_equal(before, again):
            break
    np.testing.assert_allclose(z, again, rtol=2e-3, atol=2e-3 * again.max())


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.floats(0.01, 0.5))
def test_dips_are_widened_by_half_a_window_on_each_side(seed: int, window: float) -> None:
    rng = np.random.default_rng(seed)
    s, ceiling = np.cumsum(rng.uniform(0.001, 0.1, 40)), rng.uniform(0.1, 2.0, 40)
    dips = [k for k in range(1, 39) if ceiling[k] <= ceiling[k - 1] and ceiling[k] < ceiling[k + 1]]
    expected = [
        min([ceiling[k], *(ceiling[d] for d in dips if -h(d, ceiling, window) <= s[k] - s[d] < h(d, ceiling, window))])
        for k in range(40)
    ]
    np.testing.assert_array_equal(widen_dips(s, ceiling, window), expected)


def h(dip: int, ceiling: np.ndarray, window: float) -> float:
    return float(0.5 * window * np.sqrt(ceiling[dip]))


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.floats(0.01, 1.0), st.floats(1.0, 2.0))
def test_the_time_law_is_a_moving_average(seed: int, window: float, stretch: float) -> None:
    rng = np.random.default_rng(seed)
    times = np.append(0.0, np.cumsum(rng.uniform(0.01, 0.2, 12)))
    speed = np.append(np.append(0.0, rng.uniform(0.1, 2.0, 11)), 0.0)
    change = np.diff(speed) / np.diff(times)
    rate = PPoly(np.array([change, speed[:-1]]), times)
    way = rate.antiderivative()
    area = way.antiderivative()
    t = np.linspace(0.0, (times[-1] + window) * stretch, 57)

    def of(poly: PPoly, at: np.ndarray) -> np.ndarray:
        inside = np.clip(at, 0.0, times[-1])
        return poly(inside) + (way(times[-1]) * (at - inside) * (at > inside) if poly is area else 0.0)

    evaluated = moving_average_law(t, times, way(times), speed, change, area(times), window, stretch)
    for k, poly in enumerate((area, way, rate)):
        mean = (of(poly, t / stretch) - of(poly, t / stretch - window)) / window / stretch**k
        np.testing.assert_allclose(evaluated[k], mean, rtol=0, atol=1e-11)


def path(seed: int, joints: int, samples: int) -> tuple[np.ndarray, np.ndarray, Any]:
    rng = np.random.default_rng(seed)
    knots = 3.0 + np.append(0.0, np.cumsum(rng.uniform(0.01, 0.2, 9)))
    coefficients = rng.normal(size=(4, joints + 7, 9))
    coefficients[3, -4] += 5.0
    s = np.sort(rng.uniform(0.0, knots[-1] - knots[0], samples))
    return knots, coefficients, (s, *rng.normal(size=(2, samples)))


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(1, 7), st.integers(1, 40))
def test_samples_match_the_spline_by_the_chain_rule(seed: int, joints: int, samples: int) -> None:
    knots, coefficients, (s, speed, acceleration) = path(seed, joints, samples)
    evaluated = evaluate_spline(knots, coefficients, s, speed, acceleration, joints)
    spline = PPoly(coefficients.transpose(0, 2, 1), knots)
    value, first, second = (spline(s + knots[0], order).T for order in range(3))
    value[-4:] /= np.linalg.norm(value[-4:], axis=0)
    expected = value, first * speed, first * acceleration + second * speed**2
    np.testing.assert_allclose(evaluated, expected, rtol=1e-12, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(1, 7), st.integers(1, 40))
def test_the_time_stretch_is_set_by_the_most_used_limit(seed: int, joints: int, samples: int) -> None:
    knots, coefficients, law = path(seed, joints, samples)
    evaluated = evaluate_spline(knots, coefficients, *law, joints)
    rng = np.random.default_rng(seed)
    ceilings, (speeds, accelerations, jerks, thirds) = rng.uniform(0.5, 2, (4, 10)), rng.uniform(0.5, 2, (4, joints))
    stretch, jerk = time_stretch_factors(knots, ceilings, law[0], evaluated, speeds, accelerations, jerks, thirds)
    rates = tcp_rates(evaluated, joints)
    (q, qd, qdd), turn = evaluated[:, :joints], evaluated[:, joints + 3 :]
    across = np.einsum("is,is->s", turn[2], turn[2]) - np.einsum("is,is->s", turn[0], turn[2]) ** 2
    for rate, rows in zip(
        rates, (evaluated[1, joints : joints + 3], 2 * turn[1], evaluated[2, joints : joints + 3]), strict=False
    ):
        np.testing.assert_allclose(rate, np.linalg.norm(rows, axis=0))
    np.testing.assert_allclose(rates[3], 2 * np.sqrt(np.maximum(across, 0)), atol=1e-6)
    full = rates / ceilings[:, np.searchsorted(knots, law[0] + knots[0])]
    speed = np.vstack([full[:2], np.abs(qd) / speeds[:, None]]).max(axis=0)
    change = np.vstack([full[2:], np.abs(qdd) / accelerations[:, None]]).max(axis=0)
    np.testing.assert_allclose(stretch, np.maximum(speed, np.sqrt(change)))
    steps = np.abs(np.diff(qdd, axis=1, prepend=np.zeros((joints, 1)))) / jerks[:, None]
    if samples > 3:
        steps[:, 2:-1] = np.maximum(steps[:, 2:-1], np.abs(np.diff(q, n=3, axis=1)) / thirds[:, None])
    np.testing.assert_allclose(jerk, steps.max(axis=0), rtol=1e-9, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(2, 30))
def test_a_law_has_constant_accelerations_between_knots(seed: int, knots: int) -> None:
    rng = np.random.default_rng(seed)
    s, z = 2.0 + np.cumsum(rng.uniform(0.01, 0.1, knots)), rng.uniform(0.1, 2.0, knots)
    time, speed, acceleration, integral = time_law(s, z)
    dt = np.diff(time)
    np.testing.assert_allclose(speed**2, z)
    np.testing.assert_allclose(np.diff(z), 2.0 * acceleration[:-1] * np.diff(s), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.diff(speed), acceleration[:-1] * dt, rtol=1e-9, atol=1e-12)
    way = PPoly(np.array([0.5 * acceleration[:-1], speed[:-1], s[:-1] - s[0]]), time)
    np.testing.assert_allclose(integral, way.antiderivative()(time), rtol=1e-9, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(0, 5))
def test_the_speed_ceiling_is_lowered_around_a_violation(seed: int, half: int) -> None:
    rng = np.random.default_rng(seed)
    knots, s = np.linspace(1.0, 2.0, 12), np.linspace(0.0, 1.0, 40)
    ceiling, speed, stretch = rng.uniform(0.5, 2.0, 12), rng.uniform(0.5, 2.0, 40), rng.uniform(0.8, 1.05, 40)
    needed = np.where(stretch > 1.01, (speed / (1.002 * stretch)) ** 2, np.inf)
    around = [needed[max(k - half, 0) : k + half + 1].min() for k in range(40)]
    after = np.clip(np.searchsorted(s, knots - 1.0), 1, 39)
    expected = np.minimum(ceiling, np.minimum(np.take(around, after), np.take(around, after - 1)))
    np.testing.assert_allclose(lower_ceiling(ceiling, knots, s, speed, stretch, 1.01, half), expected)


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(4, 20))
def test_cubics_and_their_derivatives_are_those_of_the_spline(seed: int, knots: int) -> None:
    rng = np.random.default_rng(seed)
    x, rows = np.cumsum(rng.uniform(0.1, 0.3, knots)), rng.normal(size=(9, knots))
    rows[-4:] /= np.linalg.norm(rows[-4:], axis=0)
    spline = CubicSpline(x, rows.T)
    coefficients = not_a_knot(x, rows)
    np.testing.assert_allclose(coefficients, spline.c.transpose(0, 2, 1), rtol=0, atol=1e-7 * np.abs(spline.c).max())
    evaluated, (travel, turn) = derivatives(coefficients, x[-1] - x[-2], np.ascontiguousarray(rows[-4:].T))
    np.testing.assert_allclose(
        evaluated[:2], [spline(x, 1).T, spline(x, 2).T], rtol=0, atol=1e-8 * np.abs(evaluated[1]).max()
    )
    third = 6.0 * np.abs(coefficients[0])
    larger = np.maximum(np.append(third, third[:, -1:], axis=1), np.append(third[:, :1], third, axis=1))
    np.testing.assert_allclose(np.abs(evaluated[2]), larger)
    np.testing.assert_array_equal(travel, evaluated[:2, 2:5].transpose(0, 2, 1))
    for rate, rows_of in zip(turn, evaluated[:2, 5:], strict=True):
        product = (
            Rotation.from_quat(rows_of.T, scalar_first=True) * Rotation.from_quat(rows[-4:].T, scalar_first=True).inv()
        )
        size = np.linalg.norm(rows_of, axis=0)
        expected = 2.0 * size[:, None] * product.as_quat(scalar_first=True)[:, 1:]
        sign = np.sign(np.einsum("ki,ki->k", expected, rate))[:, None]
        np.testing.assert_allclose(rate, sign * expected, rtol=0, atol=1e-9 * size.max())


def test_a_nan_violates_every_limit() -> None:
    knots, coefficients, (s, speed, acceleration) = path(1, 2, 9)
    speed[4] = np.nan
    evaluated = evaluate_spline(knots, coefficients, s, speed, acceleration, 2)
    ones = np.ones(2)
    stretch, jerk = time_stretch_factors(knots, np.ones((4, 10)), s, evaluated, ones, ones, ones, ones)
    assert np.isnan(stretch[4])
    assert np.isnan(jerk[4])


MODULE = """
from agent.compiled.compiling import compiled

@compiled("f8(f8)")
def twice(x: float) -> float:
    return 2.0 * x
"""


def use(folder: Path, name: str) -> None:
    folder.mkdir()
    (folder / f"{name}.py").write_text(MODULE)
    if not (folder / "__pycache__").exists():
        (folder / "__pycache__").write_text("no folder")  # as good as one that cannot be written: root can write all
    assert loaded(folder / f"{name}.py").twice(2.0) == 4.0


@pytest.fixture
def own(tmp_path: Path, monkeypatch: Any) -> Path:
    """The private folder of a user whose other folders cannot be written."""
    monkeypatch.setenv("HOME", "/dev/null")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / f"calibration-agent-{os.getuid()}"


def test_the_cache_falls_back_to_a_private_folder(tmp_path: Path, own: Path) -> None:
    use(tmp_path / "one", "read_only")
    assert own.stat().st_mode & 0o777 == 0o700
    assert list(own.rglob("*.nbc"))


def test_a_cache_folder_writable_by_others_is_not_read(tmp_path: Path, own: Path) -> None:
    own.mkdir()
    own.chmod(0o777)
    use(tmp_path / "two", "shared_folder")
    assert not list(own.iterdir())


def test_commands_without_planning_do_not_load_the_compiler() -> None:
    modules = "agent.estimation.identification, agent.validation.torque, agent.diagnosis.workflow"
    script = (
        f"import sys, {modules}, agent.recipe; agent.recipe.load_recipe(sys.argv[1]); assert 'numba' not in sys.modules"
    )
    recipe = Path(__file__).parents[2] / "recipes/ns16_quickstart.yaml"
    assert subprocess.run([sys.executable, "-c", script, recipe], check=False).returncode == 0
