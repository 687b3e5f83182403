"""The effects beside a corrected simulator: with them it has the torque of our model."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.simulators.corrected.corrected_file import write_corrected
from tests.model.correcting import (
    PATHS,
    corrected,
    entry,
    loaded,
    motion,
    simulator,
    torque_of_file,
)

CASES = {
    "friction": entry("friction_change", "lift", coulomb_change=0.7, viscous_change=0.2),
    "payload": entry(
        "payload", m0=1, hx0=0.1, hy0=0, hz0=0.05, mass=1, moment_x=0.1, moment_y=0, moment_z=0.05, inertia=0.004
    ),
    "base_tilt": entry("base_tilt", tilt_1=0.05, tilt_2=-0.03),
    "encoder_offset": entry("encoder_offset", "lift", offset=0.04),
    "spring": entry("gravity_spring", "lift", constant=0.4, stiffness=2.5),
    "straight hose": entry("dress_pack", "lift", constant=0.4, stiffness=2.5),
    "spring that pushes": entry("gravity_spring", "lift", constant=0.4, stiffness=-40),
    "stribeck": entry("stribeck", "pan", speed=0.2, shape=2, rise=1.5),
    "stribeck, with its reversal": entry(
        "stribeck", "pan", speed=0.2, shape=2, rise=1.5, reversal_travel=0.02, reversal_level=1.5
    ),
    "asymmetric_friction": entry(
        "asymmetric_friction", "lift", coulomb=1, viscous=1, coulomb_asymmetry=0.3, viscous_asymmetry=0.1
    ),
    "load_dependent_friction": entry("load_dependent_friction", "lift", coefficient=0.08),
    "load_dependent_friction, another power": entry(
        "load_dependent_friction", "lift", power=2, load=20, coefficient=0.08
    ),
    "load_dependent_friction, sheared": entry(
        "load_dependent_friction", "lift", sheared=1, coefficient=0.05, sheared_coefficient=0.1
    ),
    "load_dependent_friction, driven": entry(
        "load_dependent_friction", "lift", driven=1, coefficient=0.1, driven_coefficient=0.04
    ),
    "shear": entry("viscous_nonlinearity", "pan", speed=0.3, bend=0.8, viscous_change=-0.2),
    "power": entry("viscous_nonlinearity", "pan", power=3, bend=0.1, viscous_change=0.1),
    "thermal_friction": entry(
        "thermal_friction",
        "pan",
        time_constant=0.6,
        coulomb_change=0.2,
        coulomb_drift=1,
        viscous_change=0,
        viscous_drift=0.1,
    ),
    "warming by the way gone": entry(
        "thermal_friction", "pan", way=0.8, coulomb_change=0.2, coulomb_drift=1, viscous_change=0, viscous_drift=0.1
    ),
    "presliding": entry("presliding", "lift", travel=0.02, level=1.2),
    "torque_ripple": entry(
        "torque_ripple", "turn", order=40, harmonics=2, cosine_1=0.2, sine_1=0.1, cosine_2=0, sine_2=0.05
    ),
    "gravity_spring": entry("gravity_spring", "lift", harmonics=1, cosine_1=2, sine_1=-1),
    "hose": entry(
        "dress_pack",
        "lift",
        low=-0.4,
        high=0.45,
        travel=0.03,
        hysteresis=0.5,
        **{f"torque_{k}": v for k, v in enumerate((0.1, 0.4, 0.2, -0.3, -0.5, -1.5))},
    ),
    "hose that hardens": entry(
        "dress_pack", "lift", middle=0.1, reach=0.4, constant=0.2, stiffness=0.8, quadratic=-0.6, cubic=3
    ),
    "wrist_coupling": entry("wrist_coupling", "lift", "turn", ratio=0.3, rotor=0.1, share=1.1),
    "wrist_coupling, free": entry(
        "wrist_coupling",
        "lift",
        "turn",
        ratio=-0.4,
        free=1,
        axle_side=1,
        rotor=0.1,
        viscous=0.3,
        coulomb=0.2,
        transmission=-0.9,
    ),
    "wrist_coupling, rubbing besides": entry(
        "wrist_coupling",
        "lift",
        "turn",
        ratio=1.3,
        besides=1,
        turning=1,
        rotor=0.1,
        share=0.9,
        viscous=0.3,
        coulomb=0.2,
    ),
    "wrist_coupling, a shaft besides": entry(
        "wrist_coupling", "lift", "turn", ratio=-0.7, besides=1, shaft=1, inertia=0.05, viscous=0.3, coulomb=0.2
    ),
    "torque_constant": entry("torque_constant", "pan", scale_error=0.07),
    "torque_offset": entry("torque_offset", "turn", offset=0.3),
}
TWO_MASS = {
    "joint_elasticity": entry("joint_elasticity", "turn", stiffness=60, damping=0.05, share=1),
    "backlash": entry("backlash", "turn", stiffness=60, damping=0.1, gap=0.01, share=1),
}


@pytest.mark.parametrize("kind", PATHS)
@pytest.mark.parametrize("what", [*CASES, *TWO_MASS])
def test_the_file_and_its_effects_give_the_torque_of_our_model(what, kind, tmp_path):
    given = simulator(tmp_path, kind)
    found = corrected(given, [{**CASES, **TWO_MASS}[what]])
    if what in TWO_MASS:  # our prediction damps by the mean inertia along the motion
        mass = [found.model.rigid.dynamics.mass_matrix(row) for row in motion()[1]]
        found = replace(found, inertia=np.mean([np.diag(matrix) for matrix in mass], axis=0))
    out = tmp_path / f"fixed{given.arm.path.suffix}"
    written = write_corrected(given, found, out)
    time, q, qd, qdd = motion()
    expected = found.model.predict(q, qd, qdd, time)
    code = [path for path in written if path.suffix == ".py"]
    module = (
        loaded(code[0])
        if code
        else loaded(
            write_corrected(given, corrected(given, [CASES["torque_offset"]]), tmp_path / f"no{out.suffix}")[-1]
        )
    )
    if not code:
        module.EFFECTS = ()
    torque = torque_of_file(out, module, q, qd, qdd)
    plain = given.model.predict(q, qd, qdd, time)
    assert np.abs(expected - plain).max() > 1e-3 * np.abs(plain).max()
    apart = np.abs(torque - expected).max(axis=1)
    # mass matrices are interpolated in our prediction of two masses, and teeth may meet a step earlier
    tolerance, size = {"joint_elasticity": (1e-3, apart.max()), "backlash": (3e-3, np.sqrt(np.mean(apart**2)))}.get(
        what, (1e-6, apart.max())
    )
    assert size < tolerance * np.abs(expected).max()


def test_the_effects_need_numpy_alone_and_take_many_arms_at_once(tmp_path):
    given = simulator(tmp_path, "urdf")
    effects = [entry for name, entry in CASES.items() if name not in ("payload", "base_tilt", "encoder_offset")]
    path = write_corrected(given, corrected(given, [*effects, *TWO_MASS.values()]), tmp_path / "fixed.urdf")[-1]
    text = path.read_text()
    assert set(re.findall(r"^(?:import|from) (\w+)", text, re.M)) == {"__future__", "numpy", "typing"}
    module = loaded(path)
    many, one = module.Effects((4, 2), dt=0.01), module.Effects(dt=0.01)
    rng = np.random.default_rng(0)
    for q, qd, qdd, load in rng.uniform(-1, 1, (20, 4, 4, 2, 3)):
        both = many.torque(q, qd, qdd, load)
        np.testing.assert_allclose(both[1, 0], one.torque(q[1, 0], qd[1, 0], qdd[1, 0], load[1, 0]), atol=1e-12)
        assert many.reading(both).shape == (4, 2, 3)
    subprocess.run(
        [sys.executable, "-I", "-c", "import runpy, sys; runpy.run_path(sys.argv[1])", str(path)], check=True
    )


def test_mujoco_takes_the_effects_as_passive_forces(tmp_path):
    import mujoco

    given = simulator(tmp_path, "mjcf")
    written = write_corrected(given, corrected(given, [CASES["gravity_spring"]]), tmp_path / "fixed.xml")
    module = loaded(written[-1])
    model = mujoco.MjModel.from_xml_path(str(written[0]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    before = data.qfrc_passive.copy()
    try:
        module.install(mujoco, model)
        mujoco.mj_forward(model, data)
        q = data.qpos[1]
        assert (data.qfrc_passive - before)[1] == pytest.approx(-(2 * np.cos(q) - np.sin(q)))
        mujoco.mj_step(model, data, 50)
        assert np.all(np.isfinite(data.qpos))
    finally:
        mujoco.set_mjcb_passive(None)


def test_a_payload_without_a_mass_gives_no_torque_and_says_so(tmp_path):
    """As somebody may write it into a model's file by hand."""
    values = {"m0": 0, "hx0": 0.1, "hy0": 0, "hz0": 0.05, "mass": 1, "moment_x": 0, "moment_y": 0, "moment_z": 0}
    model = replace(simulator(tmp_path, "urdf").model, effects=(entry("payload", **values, inertia=0.004),))
    time, q, qd, qdd = motion()
    with pytest.raises(InputError, match="payload gives no finite torque with m0 0"):
        model.predict(q, qd, qdd, time)
