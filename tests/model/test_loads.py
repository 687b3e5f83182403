"""Identified loads in the words of vendors: each text, read back by its vendor's own rules, is the load again."""

import json
import re
from dataclasses import replace
from math import cos, radians, sin

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from typer.testing import CliRunner

from agent.cli import main
from agent.cli.app import app
from agent.core import InputError, RejectedError
from agent.model import CATALOGUE, IdentifiedModel, ModelEffect
from agent.robot import LINK_PARAMETERS
from agent.simulators import identified_load, load_text
from tests.estimation.test_export import bodies, described, joint, model_of

PAYLOAD = CATALOGUE["payload"]
#: The flange lies turned and shifted in the last link.
FLANGE = (np.array([0.1, 0.0, 0.2]), (0.3, -0.7, 1.1))
LINKS = (
    joint("j1", "revolute", "base", "a", "0 1 0")
    + joint("j2", "revolute", "a", "b", "1 0 0")
    + joint("plate", "fixed", "b", "flange", rpy=" ".join(map(str, FLANGE[1])))
)


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> IdentifiedModel:
    robot = described(tmp_path_factory.mktemp("arm"), LINKS, ("j1", "j2"), "flange")
    return model_of(robot, bodies(robot), known=True)


def turned(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll), element by element."""
    x = np.array([[1, 0, 0], [0, cos(roll), -sin(roll)], [0, sin(roll), cos(roll)]])
    y = np.array([[cos(pitch), 0, sin(pitch)], [0, 1, 0], [-sin(pitch), 0, cos(pitch)]])
    z = np.array([[cos(yaw), -sin(yaw), 0], [sin(yaw), cos(yaw), 0], [0, 0, 1]])
    return z @ y @ x


def points(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Masses (P,) and positions (P, 3) in the flange's frame."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.05, 0.5, 6), rng.uniform(-0.15, 0.15, (6, 3)) + rng.uniform(-0.1, 0.1, 3)


def about(masses: np.ndarray, places: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(3, 3) Σ m (r² 1 - r rᵀ) about a point."""
    arms = places - centre
    return sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, arms, strict=True))


def carried(masses: np.ndarray, places: np.ndarray) -> ModelEffect:
    """The effect that such points on the flange are, in the last link's frame."""
    there = places @ turned(*FLANGE[1]).T + FLANGE[0]
    inertia, moment = about(masses, there, np.zeros(3)), masses @ there
    keys = {"xx": (0, 0), "xy": (0, 1), "yy": (1, 1), "xz": (0, 2), "yz": (1, 2), "zz": (2, 2)}
    own = {f"inertia_{key}": float(inertia[at]) for key, at in keys.items()}
    first = dict(zip(("mass", "moment_x", "moment_y", "moment_z"), map(float, (masses.sum(), *moment)), strict=True))
    return ModelEffect("payload", (), {**first, **own})


def numbers(text: str) -> list[float]:
    return [float(word) for word in re.findall(r"-?\d+\.?\d*(?:[eE][-+]?\d+)?", text)]


def symmetric(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> np.ndarray:
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def read_ur(text: str):
    m, x, y, z, *inertia = numbers(re.search(r"set_target_payload\((.*)\)$", text, re.M)[1])
    return m, np.array([x, y, z]), symmetric(*inertia)


def read_abb(text: str):
    m, x, y, z, q1, q2, q3, q4, *moments = numbers(re.search(r":=\[(.*)\];$", text, re.M)[1])
    assert q1**2 + q2**2 + q3**2 + q4**2 == pytest.approx(1, abs=1e-8)
    turn = np.array(
        [
            [1 - 2 * (q3**2 + q4**2), 2 * (q2 * q3 - q1 * q4), 2 * (q2 * q4 + q1 * q3)],
            [2 * (q2 * q3 + q1 * q4), 1 - 2 * (q2**2 + q4**2), 2 * (q3 * q4 - q1 * q2)],
            [2 * (q2 * q4 - q1 * q3), 2 * (q3 * q4 + q1 * q2), 1 - 2 * (q2**2 + q3**2)],
        ]
    )
    return m, np.array([x, y, z]) / 1000, turn @ np.diag(moments) @ turn.T


def read_kuka(text: str):
    named = re.search(r"\{M (.*),CM \{X (.*),Y (.*),Z (.*),A (.*),B (.*),C (.*)\},J \{X (.*),Y (.*),Z (.*)\}\}", text)
    m, x, y, z, a, b, c, *moments = (float(word) for word in named.groups())
    turn = turned(radians(c), radians(b), radians(a))
    return m, np.array([x, y, z]) / 1000, turn @ np.diag(moments) @ turn.T


def read_franka(text: str):
    document = json.loads(text)
    assert document["transformation"] == np.eye(4).ravel().tolist()
    columns = [document["inertia"][3 * k : 3 * k + 3] for k in range(3)]
    return document["mass"], np.array(document["centerOfMass"]), np.column_stack(columns)


def read_comau(text: str):
    values = dict(line.split(" := ") for line in text.splitlines() if not line.startswith("--"))
    centre = np.array(numbers(values["$TOOL_CNTR"])[:3]) / 1000
    return float(values["$TOOL_MASS"]), centre, symmetric(*(float(values[f"$TOOL_INERTIA[{k}]"]) for k in range(1, 7)))


READERS = {"ur": read_ur, "abb": read_abb, "kuka": read_kuka, "franka": read_franka, "comau": read_comau}


@pytest.mark.parametrize("vendor", READERS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 10_000))
def test_a_load_reads_back_by_the_vendors_rules(vendor: str, seed: int, bare: IdentifiedModel) -> None:
    masses, places = points(seed)
    text, _ = load_text(identified_load(replace(bare, effects=(carried(masses, places),))), vendor)
    mass, centre, inertia = READERS[vendor](text)
    assert mass == pytest.approx(masses.sum(), rel=1e-8)
    expected = masses @ places / masses.sum()
    np.testing.assert_allclose(centre, expected, atol=1e-8)
    np.testing.assert_allclose(inertia, about(masses, places, expected), atol=1e-8)


@pytest.mark.parametrize("vendor", READERS)
def test_axes_parallel_to_the_flange_are_kept(vendor: str, bare: IdentifiedModel) -> None:
    places = np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.06, 0], [0, -0.06, 0], [0, 0, 0.02], [0, 0, -0.02]])
    text, _ = load_text(identified_load(replace(bare, effects=(carried(np.full(6, 0.25), places),))), vendor)
    np.testing.assert_allclose(READERS[vendor](text)[2], about(np.full(6, 0.25), places, np.zeros(3)), atol=1e-9)
    turn = {"abb": "[1.0, 0.0, 0.0, 0.0]", "kuka": "A 0.0,B 0.0,C 0.0"}.get(vendor, "")
    assert turn in text.replace("-0.0", "0.0")


def ball(mass: float, centre: np.ndarray, inertia: float | None, intervals: dict | None = None) -> ModelEffect:
    """As a diagnosis finds it: a ball of its own inertia, or a point."""
    moment = mass * (turned(*FLANGE[1]) @ centre + FLANGE[0])
    start = dict(zip(("m0", "hx0", "hy0", "hz0"), map(float, (mass, *moment)), strict=True))
    found = dict(zip(("mass", "moment_x", "moment_y", "moment_z"), start.values(), strict=True))
    own = {"point_mass": 1.0} if inertia is None else {"inertia": inertia}
    return ModelEffect("payload", (), {**start, **found, **own}, intervals or {})


def test_exports_inertia_about_the_centre_of_mass_and_intervals_as_comments(bare: IdentifiedModel, tmp_path) -> None:
    centre = np.array([0.02, -0.01, 0.08])
    moments = {f"moment_{axis}": (0.0, 0.03) for axis in "xyz"}
    entry = ball(1.5, centre, 0.004, {"mass": (1.45, 1.55), "inertia": (0.003, 0.005), **moments})
    replace(bare, effects=(entry,)).save(tmp_path / "model.json")
    assert IdentifiedModel.load(tmp_path / "model.json").effects == (entry,)
    shown = CliRunner().invoke(app, ["export", str(tmp_path / "model.json"), "--load", "UR"])
    assert shown.exit_code == 0, shown.output
    *comments, line = shown.stdout.splitlines()
    mass, found, inertia = read_ur(line)
    assert (mass, *found) == pytest.approx((1.5, *centre), abs=1e-8)
    np.testing.assert_allclose(inertia, 0.004 * np.eye(3), atol=1e-9)
    assert all(comment.startswith("# ") for comment in comments)
    said = "\n".join(comments)
    assert "1.5 kg, 95 % interval ±0.05 kg" in said
    assert "±0.001 kg·m²" in said
    half = re.search(r"20.00, -10.00, 80.00 mm, 95 % interval ±(.*) mm", said)[1]
    assert all(10 <= float(word) <= 20 for word in half.split(","))  # 10 mm by the moments, the rest by the mass
    axes = joint("j1", "revolute", "base", "a") + joint("j2", "revolute", "a", "b")  # upright: no weight acts on them
    upright = described(tmp_path, axes, ("j1", "j2"), "b")
    model = replace(model_of(upright, bodies(upright), known=True), effects=(entry,))
    assert re.search(r"±\d.*, \d.*, inf mm.\n.*±inf: take it from", load_text(identified_load(model), "ur")[0])


def test_intervals_go_to_stderr_if_the_format_has_no_comments(bare: IdentifiedModel, tmp_path) -> None:
    replace(bare, effects=(ball(1.5, np.zeros(3), None),)).save(tmp_path / "model.json")
    shown = CliRunner().invoke(app, ["export", str(tmp_path / "model.json"), "--load", "franka"])
    assert shown.exit_code == 0
    assert read_franka(shown.stdout)[0] == pytest.approx(1.5)
    assert "point mass" in shown.stderr
    assert "intervals are not in the model" in shown.stderr


def test_other_parameters_of_the_last_link_are_a_load(bare: IdentifiedModel) -> None:
    """Torque does not distinguish them; those of another link are none."""
    load = carried(*points(4))
    names = dict(zip(PAYLOAD.names({}), LINK_PARAMETERS, strict=True))

    def of_link(number: int) -> IdentifiedModel:
        parameters = {f"{names[name]}{number}": value for name, value in load.parameters.items()}
        intervals = {f"m{number}": (load.parameters["mass"] - 0.1, load.parameters["mass"] + 0.1)}
        return replace(bare, effects=(ModelEffect("inertial_mismatch", (), {"link": number, **parameters}, intervals),))

    expected, found = identified_load(replace(bare, effects=(load,))), identified_load(of_link(2))
    assert found.mass_error == pytest.approx(0.1)
    np.testing.assert_allclose(found.centre, expected.centre)
    np.testing.assert_allclose(found.inertia, expected.inertia, atol=1e-12)
    with pytest.raises(InputError, match="no identified load"):
        identified_load(of_link(1))


def test_a_ball_is_one_of_its_own_mass_and_centre(bare: IdentifiedModel) -> None:
    """Not of those, a little off, that its inertia was linearised at: a point would be no possible body."""
    entry = ball(2.0, np.array([0.1, 0.0, 0.3]), None)
    off = replace(entry, parameters={**entry.parameters, "m0": 1.99, "hz0": entry.parameters["hz0"] + 0.01})
    np.testing.assert_allclose(identified_load(replace(bare, effects=(off,))).inertia, 0.0, atol=1e-9)


def test_several_loads_are_combined(bare: IdentifiedModel) -> None:
    parts = [points(1), points(2)]
    found = identified_load(replace(bare, effects=tuple(carried(*part) for part in parts)))
    masses, places = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    assert found.mass == pytest.approx(masses.sum())
    np.testing.assert_allclose(found.inertia, about(masses, places, masses @ places / masses.sum()), atol=1e-9)


def test_refuses_to_export_an_impossible_load(bare: IdentifiedModel) -> None:
    with pytest.raises(RejectedError, match=r"-1 kg: the arm carries less"):
        identified_load(replace(bare, effects=(ball(-1.0, np.zeros(3), None),)))
    masses, places = points(3)
    thin = carried(masses, places)
    thin.parameters["inertia_xx"] += 1.0
    with pytest.raises(RejectedError, match="no body has them"):
        identified_load(replace(bare, effects=(thin,)))
    with pytest.raises(InputError, match="no such vendor; there are ur, abb, kuka, franka, comau"):
        load_text(identified_load(replace(bare, effects=(carried(masses, places),))), "acme")


@pytest.mark.parametrize(
    ("frames", "wanted", "found"),
    [
        ((("tool0", "0 0 1.5708"),), None, ("tool0", "0 0 1.5708", "usual name")),
        ((("left_tool0", "0 1 0"), ("flange", "0 0 0")), None, ("left_tool0", "0 1 0", "usual name")),
        ((("camera", "0 1 0"), ("panda_link8", "0 0 0.7854")), None, ("panda_link8", "0 0 0.7854", "usual name")),
        ((("flange", "0 0 1"), ("ee_link", "0 0 1")), None, ("flange", "0 0 1", "usual name")),
        ((("flange", "0 0 1"), ("ee_link", "0 1 0")), "ee_link", ("ee_link", "0 1 0", "--flange")),
        ((("camera", "0 1 0"),), None, ("b", "0 0 0", "no frame beyond it is called like a flange")),
        ((("flange", "0 0 1"), ("ee_link", "0 1 0")), None, "flange and ee_link .* --flange flange, or as tip_frame"),
        ((("flange", "0 0 1"),), "wrist", "--flange wrist: no frame fixed to the last link of r; it has b, flange"),
    ],
)
def test_a_load_is_in_the_flange_that_the_description_has(tmp_path, frames, wanted, found):
    """The tip frame is the last moving link, as it is of an arm that a URDF alone describes."""
    plates = "".join(joint(name, "fixed", "b", name, rpy=turn) for name, turn in frames)
    robot = described(tmp_path, LINKS.split('<joint name="plate"')[0] + plates, ("j1", "j2"), "b")
    masses, places = points(4)
    inertia, first = about(masses, places, np.zeros(3)), masses @ places
    keys = {"xx": (0, 0), "xy": (0, 1), "yy": (1, 1), "xz": (0, 2), "yz": (1, 2), "zz": (2, 2)}
    values = dict(zip(("mass", "moment_x", "moment_y", "moment_z"), map(float, (masses.sum(), *first)), strict=True))
    values |= {f"inertia_{key}": float(inertia[at]) for key, at in keys.items()}
    model = replace(model_of(robot, bodies(robot), known=True), effects=(ModelEffect("payload", (), values),))
    if isinstance(found, str):
        with pytest.raises(InputError, match=found):
            identified_load(model, wanted)
        return
    load = identified_load(model, wanted)
    frame, turn, how = found
    origin = np.zeros(3) if frame == "b" else np.array([0.1, 0, 0.2])  # that of `joint`
    expected = turned(*map(float, turn.split())).T @ (first / masses.sum() - origin)
    np.testing.assert_allclose(load.centre, expected, atol=1e-9)
    assert load.flange == frame
    assert f"Frame: {frame} (" in load_text(load, "abb")[0]
    assert how in load_text(load, "abb")[0]


def test_a_load_that_only_rounding_makes_impossible_is_exported(bare: IdentifiedModel) -> None:
    """A point at arm's length, whose centre a file rounds to a micrometre."""
    point = carried(np.array([2.0]), np.array([[0.0, 0.0, 0.06]]))
    point.parameters["inertia_zz"] -= 4e-7
    low, middle, high = np.linalg.eigvalsh(identified_load(replace(bare, effects=(point,))).inertia)
    assert low >= -np.finfo(float).eps * high  # the eigenvalues are rounded too
    assert low + middle >= high - 1e-15
    assert high < 1e-6


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--load", "ur"], "no identified load"),
        ([], "-o DIR for URDF, MuJoCo model, SDF, friction file and table; "),
        ([], "or --load ur|abb|kuka|franka|comau for the load"),
        ([], "--for mjcf|isaaclab|mjlab|usd|newton|genesis|csv -o DIR for one simulator"),
        (["--load", "ur", "-o", "out"], "one of them at a time"),
        (["-o", "out", "--flange", "tool0"], "--flange belongs to --load"),
    ],
)
def test_wrong_usage_gives_one_message(bare: IdentifiedModel, tmp_path, monkeypatch, capsys, options, said) -> None:
    bare.save(tmp_path / "model.json")
    monkeypatch.setattr("sys.argv", ["agent", "export", str(tmp_path / "model.json"), *options])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert said in shown.err
    assert shown.err.count("\n") == 1
