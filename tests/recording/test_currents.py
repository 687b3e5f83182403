"""Logs of a link that delivers motor currents: a topic of their own, and what the torque was computed with."""

import json
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from agent.core.errors import InputError
from agent.link.controller import create_driver, torque_facts
from agent.recipe import load_recipe
from agent.recording import LogWriter, read_log
from agent.robot import load_robot, torque_per_ampere
from drivers.protocol import SampleBlock
from tests.conftest import ROOT

NAMES = ("a", "b")


def block(current):
    count = 50
    q = np.column_stack([np.arange(count), -np.arange(count)]) * 0.01
    return SampleBlock(np.arange(count), 5.0 + np.arange(count) / 500.0, q, q, q, q, q, current=current)


def topics(path):
    with open(path, "rb") as file:
        return {channel.topic for channel in make_reader(file).get_summary().channels.values()}


def test_motor_currents_have_their_own_topic(tmp_path):
    mcap_ros2 = pytest.importorskip("mcap_ros2.decoder")
    current = np.column_stack([np.arange(50), 2.0 * np.arange(50)])
    path = tmp_path / "log.mcap"
    with LogWriter(path, NAMES, robot="r", motion="m", sample_rate=500.0) as writer:
        writer.write(block(current))
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[mcap_ros2.DecoderFactory()])
        found = [m for _, c, _, m in reader.iter_decoded_messages() if c.topic == "/motor_currents"]
    np.testing.assert_array_equal([m.effort for m in found], current)
    assert [(list(m.name), list(m.position), list(m.velocity)) for m in found] == [(list(NAMES), [], [])] * 50
    assert read_log(path).effort[3, 0] == 0.03  # torque stays what it was


def test_a_link_with_torque_has_no_current_topic(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path, NAMES, robot="r", motion="m", sample_rate=500.0) as writer:
        writer.write(block(None))
    assert "/motor_currents" not in topics(path)


def test_stores_facts_from_start_and_end_of_a_recording(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path, NAMES, robot="r", motion="m", sample_rate=500.0, facts={"known": "before"}) as writer:
        writer.write(block(None))
        writer.note({"clock_offset_s": "1.5"})
    run = read_log(path).metadata
    assert (run["known"], run["clock_offset_s"], run["robot"]) == ("before", "1.5", "r")


def test_torque_per_ampere_includes_gears_and_coupling():
    robot = load_robot("comau_ns16")
    robot = replace(robot, motor_coupling=tuple(map(tuple, np.eye(6) + 0.02 * np.eye(6, k=-1))))
    current = np.arange(1.0, 7.0)
    motor = current * [joint.torque_constant for joint in robot.joints]
    # Virtual work: motor torque times motor speed is joint torque times joint speed, for every joint speed.
    for speed in np.eye(6):
        motor_speed = robot.gear_ratios * (robot.coupling @ speed)
        assert (torque_per_ampere(robot) @ current) @ speed == pytest.approx(motor @ motor_speed)


def test_refuses_a_current_link_for_a_robot_without_torque_constants():
    robot = load_robot("comau_ns16")
    plain = load_recipe(ROOT / "recipes/ns16_quickstart.yaml")
    first, *others = robot.joints
    plain = replace(plain, robot=replace(robot, joints=(replace(first, torque_constant=None), *others)))
    on_currents = replace(
        plain, controller=plain.controller.model_copy(update={"driver": "cnr_comau", "address": "127.0.0.1"})
    )
    with pytest.raises(InputError, match="no torque_constant for joint_1:"):
        create_driver(on_currents, print)
    assert torque_facts(plain, create_driver(plain, print)) == {}
    real = replace(on_currents, robot=load_robot("comau_ns16"))
    driver = create_driver(real, print)
    np.testing.assert_array_equal(driver.torque_per_ampere, torque_per_ampere(real.robot))
    assert driver.tell is print
    assert json.loads(torque_facts(real, driver)["torque_constants_nm_per_a"])["joint_2"] == 0.6
