"""The effects next to a corrected simulator: with them it has the torque of the identified model."""

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.simulators.corrected.corrected_file import write_corrected
from tests.conftest import ROOT, loaded
from tests.model.correcting import PATHS, corrected, entry, motion, simulator, torque_of_file

EFFECTS_FILE = ROOT / "agent" / "simulators" / "corrected" / "standalone_effects.py"
#: Effect, joints and parameters of every form.
CASES = {
    "friction": "friction_change lift coulomb_change=0.7 viscous_change=0.2",
    "payload": "payload m0=1 hx0=0.1 hy0=0 hz0=0.05 mass=1 moment_x=0.1 moment_y=0 moment_z=0.05 inertia=0.004",
    "base_tilt": "base_tilt tilt_1=0.05 tilt_2=-0.03",
    "encoder_offset": "encoder_offset lift offset=0.04",
    "spring": "gravity_spring lift constant=0.4 stiffness=2.5",
    "straight hose": "dress_pack lift constant=0.4 stiffness=2.5",
    "spring that pushes": "gravity_spring lift constant=0.4 stiffness=-40",
    "stribeck": "stribeck pan speed=0.2 shape=2 rise=1.5",
    "stribeck with a reversal": "stribeck pan speed=0.2 shape=2 rise=1.5 reversal_travel=0.02 reversal_level=1.5",
    "asymmetry": "asymmetric_friction lift coulomb=1 viscous=1 coulomb_asymmetry=0.3 viscous_asymmetry=0.1",
    "load": "load_dependent_friction lift coefficient=0.08",
    "load, another power": "load_dependent_friction lift power=2 load=20 coefficient=0.08",
    "load, sheared": "load_dependent_friction lift sheared=1 coefficient=0.05 sheared_coefficient=0.1",
    "load, driven": "load_dependent_friction lift driven=1 coefficient=0.1 driven_coefficient=0.04",
    "shear": "viscous_nonlinearity pan speed=0.3 bend=0.8 viscous_change=-0.2",
    "power": "viscous_nonlinearity pan power=3 bend=0.1 viscous_change=0.1",
    "warming over time": "thermal_friction pan time_constant=0.6 coulomb_change=0.2 coulomb_drift=1 viscous_change=0 "
    "viscous_drift=0.1",
    "warming over distance": "thermal_friction pan way=0.8 coulomb_change=0.2 coulomb_drift=1 viscous_change=0 "
    "viscous_drift=0.1",
    "presliding": "presliding lift travel=0.02 level=1.2",
    "ripple": "torque_ripple turn order=40 harmonics=2 cosine_1=0.2 sine_1=0.1 cosine_2=0 sine_2=0.05",
    "gravity_spring": "gravity_spring lift harmonics=1 cosine_1=2 sine_1=-1",
    "hose": "dress_pack lift low=-0.4 high=0.45 travel=0.03 hysteresis=0.5 torque_0=0.1 torque_1=0.4 torque_2=0.2 "
    "torque_3=-0.3 torque_4=-0.5 torque_5=-1.5",
    "hose that hardens": "dress_pack lift middle=0.1 reach=0.4 constant=0.2 stiffness=0.8 quadratic=-0.6 cubic=3",
    "coupling": "wrist_coupling lift turn ratio=0.3 rotor=0.1 share=1.1",
    "coupling, free": "wrist_coupling lift turn ratio=-0.4 free=1 axle_side=1 rotor=0.1 viscous=0.3 coulomb=0.2 "
    "transmission=-0.9",
    "coupling that rubs": "wrist_coupling lift turn ratio=1.3 besides=1 turning=1 rotor=0.1 share=0.9 viscous=0.3 "
    "coulomb=0.2",
    "coupled shaft": "wrist_coupling lift turn ratio=-0.7 besides=1 shaft=1 inertia=0.05 viscous=0.3 coulomb=0.2",
    "torque_constant": "torque_constant pan scale_error=0.07",
    "torque_offset": "torque_offset turn offset=0.3",
    "joint_elasticity": "joint_elasticity turn stiffness=60 damping=0.05 share=1",
    "backlash": "backlash turn stiffness=60 damping=0.1 gap=0.01 share=1",
}
TWO_MASS = ("joint_elasticity", "backlash")
#: What becomes numbers of the file itself, so that the kind of file matters; an MJCF takes ten times as long as a URDF.
IN_FILE = ("friction", "payload", "base_tilt", "encoder_offset", "spring", "straight hose", "spring that pushes")
BY_KIND = [
    pytest.param(what, kind, marks=() if kind != "mjcf" or what in (*IN_FILE, "backlash") else pytest.mark.verify)
    for what in CASES
    for kind in PATHS
]


def case(name):
    effect, *words = CASES[name].split()
    return entry(
        effect, *(word for word in words if "=" not in word), **dict(word.split("=") for word in words if "=" in word)
    )


@pytest.mark.parametrize(("what", "kind"), BY_KIND)
def test_the_file_and_its_effects_give_the_torque_of_our_model(what, kind, tmp_path):
    given = simulator(tmp_path, kind)
    found = corrected(given, [case(what)])
    if what in TWO_MASS:  # our prediction damps by the mean inertia along the motion
        mass = [found.model.rigid.dynamics.mass_matrix(row) for row in motion()[1]]
        found = replace(found, inertia=np.mean([np.diag(matrix) for matrix in mass], axis=0))
    out = tmp_path / f"fixed{given.arm.path.suffix}"
    written = write_corrected(given, found, out)
    time, q, qd, qdd = motion()
    expected = found.model.predict(q, qd, qdd, time)
    if written[-1].suffix == ".py":
        module = loaded(written[-1])
    else:
        other = corrected(given, [case("torque_offset")])
        module = loaded(write_corrected(given, other, tmp_path / f"no{out.suffix}")[-1])
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
    effects = [case(name) for name in CASES if name not in ("payload", "base_tilt", "encoder_offset")]
    path = write_corrected(given, corrected(given, effects), tmp_path / "fixed.urdf")[-1]
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
    written = write_corrected(given, corrected(given, [case("gravity_spring")]), tmp_path / "fixed.xml")
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


def test_a_light_rotor_behind_a_heavy_link_follows_its_gear_with_play():
    """Against rotor and link as two bodies: MuJoCo ties the rotor to ten times its inertia, which the effect unties."""
    import mujoco

    module, rotor, link, gap, weight, kp, kv, step = loaded(EFFECTS_FILE), 0.04, 0.4, 0.02, 11.8, 100.0, 6.0, 1e-3
    stiffness, damper = link * (2 * np.pi * 40) ** 2, 0.24 * link * 2 * np.pi * 40
    gear = {"share": 1.0, "stiffness": stiffness, "damper": damper, "gap": gap}
    module.ROTORS, module.ARMATURE, module.REVERSAL, module.JOINTS = (rotor,), (0.0,), (0.01,), ("j",)
    module.EFFECTS = ({"effect": "backlash", "form": "arm_two_mass", "joints": (0,), "parameters": gear},)
    model = mujoco.MjModel.from_xml_string(
        f'''<mujoco><compiler angle="radian"/><option timestep="{step}" integrator="implicitfast"/><worldbody><body>
        <joint name="j" axis="0 1 0" armature="{rotor}"/>
        <inertial pos="0.3 0 0" mass="{weight / 0.3 / 9.81}" diaginertia="0.01 {link - 0.3 * weight / 9.81} 0.04"/>
        </body></worldbody><actuator><position joint="j" kp="{kp}" kv="{kv}"/></actuator></mujoco>'''
    )
    data = mujoco.MjData(model)
    time = step * np.arange(2000)
    asked = 1.57 + 0.5 * np.sin(4 * time) - 0.37 * np.exp(-20 * time)
    positions = np.empty(len(time))
    data.qpos[0] = asked[0]
    try:
        module.install(mujoco, model, ("j",))
        for k, now in enumerate(asked):
            positions[k] = data.qpos[0]
            data.ctrl[0] = now
            mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_passive(None)
    h, expected, angle, speed, turning = step / 20, np.empty(len(time)), asked[0], 0.0, 0.0
    place = angle + gap / 2 + weight * np.cos(angle) / stiffness
    for k, now in enumerate(asked):
        expected[k] = angle
        for _ in range(20):
            twist = angle - place
            beyond = twist - min(max(twist, -gap / 2), gap / 2)
            pull = stiffness * beyond + (damper * (speed - turning) if beyond else 0.0)
            speed += h * (kp * (now - angle) - kv * speed - pull) / rotor
            turning += h * (pull + weight * np.cos(place)) / link
            angle, place = angle + h * speed, place + h * turning
    assert np.ptp(expected) > 0.5
    assert np.sqrt(np.mean((positions - expected)[500:] ** 2)) < 0.2 * gap


def test_a_payload_without_a_mass_gives_no_torque_and_a_warning(tmp_path):
    """As somebody may write it into a model's file by hand."""
    values = {"m0": 0, "hx0": 0.1, "hy0": 0, "hz0": 0.05, "mass": 1, "moment_x": 0, "moment_y": 0, "moment_z": 0}
    model = replace(simulator(tmp_path, "urdf").model, effects=(entry("payload", **values, inertia=0.004),))
    time, q, qd, qdd = motion()
    with pytest.raises(InputError, match="payload gives no finite torque with m0 0"):
        model.predict(q, qd, qdd, time)
