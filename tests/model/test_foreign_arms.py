"""Files of arms that nobody here has seen, drawn by rule as real files are written, are read and corrected."""

from pathlib import Path

import numpy as np
import pytest

from agent.model import ModelEffect, possible_model
from agent.simulators import FittedChange, Released, correct, export_model, load_arm, load_simulator, write_corrected

ARMS = range(10)


def drawn(seed: int) -> str:
    """A URDF of 1 to 7 joints: slides, products of inertia, quarter turns of five and six digits, frames beyond."""
    rng = np.random.default_rng(seed)
    n = 1 + seed % 7
    quarters = rng.choice([-1.5708, 1.5708, -1.570796, 3.14159, 0.0, 0.785398], (n, 3))
    parts, parent = [f'<robot name="drawn_{seed}"><link name="base"/>'], "base"
    size = 10 ** rng.uniform(-1.0, 0.3)  # m: a hobby arm to a large one
    for k in range(n):
        mass = 20 * size**2 * rng.uniform(0.3, 1) / (k + 1)
        shape, turn = np.sort(rng.uniform(0.2, 1, 3)), np.linalg.qr(rng.normal(size=(3, 3)))[0]
        second = turn @ np.diag(mass * (0.2 * size * shape) ** 2) @ turn.T
        tensor = np.trace(second) * np.eye(3) - second
        inertia = " ".join(f'i{"xyz"[i]}{"xyz"[j]}="{tensor[i, j]:.6g}"' for i in range(3) for j in range(i, 3))
        slides = seed % 3 == 1 and k == n // 2
        axis = " ".join(map(str, np.eye(3)[rng.integers(3)].astype(int) * rng.choice([-1, 1])))
        origin = " ".join(f"{x:.4g}" for x in size * rng.uniform(-0.4, 0.4, 3))
        centre = " ".join(f"{x:.4g}" for x in 0.2 * size * rng.uniform(-1, 1, 3))
        parts.append(
            f'<joint name="axis_{k}" type="{"prismatic" if slides else "revolute"}"><parent link="{parent}"/>'
            f'<child link="part_{k}"/><origin xyz="{origin}" rpy="{" ".join(map(str, quarters[k]))}"/>'
            f'<axis xyz="{axis}"/><limit lower="-1.5" upper="1.5" velocity="2" effort="100"/>'
            f'<dynamics damping="{rng.uniform(0, 1):.3g}" friction="{rng.uniform(0, 1):.3g}"/></joint>'
            f'<link name="part_{k}"><inertial><origin xyz="{centre}" rpy="0.1 -0.2 1.5708"/><mass value="{mass:.6g}"/>'
            f"<inertia {inertia}/></inertial></link>"
        )
        parent = f"part_{k}"
    hand = f'<joint name="plate" type="fixed"><parent link="{parent}"/><child link="tool0"/><origin rpy="0 1.5708 0"/>'
    return "".join([*parts, hand, '</joint><link name="tool0"/></robot>'])


def write_changed(path: Path, out: Path) -> None:
    """Correct every kind of number of a file."""
    names = load_arm(path).joint_names
    given = load_simulator(path, None, names)
    n, standard = len(names), np.zeros(len(given.model.standard))
    standard[10 * n - 10 : 10 * n] = 0.2 * given.model.standard[10 * n - 10 : 10 * n]
    standard[10 * n] = 0.05
    change = np.append(given.model.projection @ standard, np.tile([0.3, 0.2], n))
    offset = ModelEffect("encoder_offset", (names[n // 2],), {"offset": 0.01})
    released = Released(links={n - 1: "x"}, rotors={0: "x"}, friction=dict.fromkeys(range(n), "x"))
    information = 1e4 * np.eye(len(given.model.independent))
    write_corrected(
        given, correct(given, FittedChange(change, information, 1.0, np.ones(n)), [offset], released, {}), out
    )


@pytest.mark.parametrize("seed", ARMS)
def test_a_urdf_of_any_arm_is_corrected(tmp_path, seed):
    (tmp_path / "arm.urdf").write_text(drawn(seed))
    write_changed(tmp_path / "arm.urdf", tmp_path / "fixed.urdf")
    assert (tmp_path / "fixed.urdf").is_file()


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.verify) for seed in ARMS if seed != 1)])
def test_an_exported_mjcf_of_any_arm_is_read_and_corrected(tmp_path, seed):
    """The quick one has a slide."""
    pytest.importorskip("mujoco")
    (tmp_path / "arm.urdf").write_text(drawn(seed))
    names = load_arm(tmp_path / "arm.urdf").joint_names
    model, _ = possible_model(load_simulator(tmp_path / "arm.urdf", None, names).model)
    mjcf = export_model(model, tmp_path / "exported")[1]
    write_changed(mjcf, tmp_path / "fixed.xml")
    assert (tmp_path / "fixed.xml").is_file()
