"""Names and bytes of ROS 2: messages as rclpy 7.1 with Fast DDS has written them, and what is damaged or hostile."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.errors import ConfigurationError, ProtocolError
from drivers.wire.ros2 import JointStateReader, RosAddress, SetPointReader, joints_of
from fake_controller.ros2.node import JointStateWriter

#: Joints elbow, gripper and shoulder; between texts and numbers are bytes that mean nothing.
JOINT_STATE = bytes.fromhex(
    "00010000b1500b6b80b2e60e0a000000626173655f6c696e6b0076ed0300000006000000656c626f770075ed080000006772697070657200"
    "0900000073686f756c6465720056000003000000000000000000e03f7b14ae47e17a843f000000000000f4bf0300000040dc75ed00000000"
    "0000d03f0000000000000000000000000000e0bf03000000607d77ed0000000000000840000000000000f87f00000000004045c0"
)
#: Joints elbow and shoulder, without velocity and effort.
POSITIONS = bytes.fromhex(
    "00010000b1500b6b80b2e60e010000000081b5000200000006000000656c626f772f31fc0900000073686f756c646572001fab0002000000"
    "3025bbfd000000000000e03f000000000000f4bf0000000000000000"
)
#: A controller_state of Jazzy; the reference is 1 and 2 rad, the speed 75 %.
STATE = bytes.fromhex(
    "000100000700000080841e000100000000636f6e020000000900000073686f756c6465720020647406000000656c626f7700656102000000"
    "20686967000000000000f03f000000000000004002000000726573759a9999999999b93f9a9999999999c93f020000006c65203d00000000"
    "00000000000000000000000000000000030000000000000002000000000000000000f83f0000000000000440020000006974657233333333"
    "3333c33f000000000000d03f0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
    "0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
    "000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000001ddf6000000000"
    "0000e83f"
)


def test_joints_are_found_by_name_in_every_message():
    reader = JointStateReader(["shoulder", "elbow"])
    sample = reader.read(JOINT_STATE)
    assert sample.stamp == pytest.approx(1795903665.25, abs=1e-6)
    assert (sample.position.tolist(), sample.velocity.tolist()) == ([-1.25, 0.5], [-0.5, 0.25])
    assert sample.effort.tolist() == [-42.5, 3.0]
    bare = reader.read(POSITIONS)
    assert bare.position.tolist() == [-1.25, 0.5]
    assert np.isnan(bare.velocity).all()
    assert np.isnan(bare.effort).all()
    assert reader.read(JOINT_STATE).position.tolist() == [-1.25, 0.5]


def test_bytes_between_the_texts_mean_nothing():
    reader = JointStateReader(["elbow"])
    reader.read(POSITIONS)
    other = POSITIONS.replace(b"\x2f\x31\xfc", b"\x01\x02\x03")
    assert other != POSITIONS
    assert reader.read(other).position.tolist() == [0.5]


def test_messages_of_another_group_are_passed_over():
    assert JointStateReader(["wrist"]).read(JOINT_STATE) is None
    assert SetPointReader(["wrist"]).read(STATE) is None


def test_a_set_point_has_reference_and_speed():
    state = SetPointReader(["elbow", "shoulder"]).read(STATE + b"left over")
    assert (state.stamp, state.scaling) == (pytest.approx(7.002), 0.75)
    assert (state.position.tolist(), state.velocity.tolist()) == ([2.0, 1.0], [0.2, 0.1])


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([JOINT_STATE, POSITIONS, STATE]), st.data())
def test_damaged_messages_are_a_protocol_error_or_numbers(message, data):
    cut = message[: data.draw(st.integers(0, len(message)))]
    spot = data.draw(st.integers(0, len(message) - 1))
    changed = message[:spot] + bytes([data.draw(st.integers(0, 255))]) + message[spot + 1 :]
    for reader in (JointStateReader(["elbow", "shoulder"]), SetPointReader(["elbow", "shoulder"])):
        for one in (cut, changed):
            try:
                found = reader.read(one)
            except ProtocolError as error:
                assert "damaged" in str(error)  # noqa: PT017
            else:
                assert found is None or found.position.shape == (2,)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.text("abcdefghij_", min_size=1, max_size=20), min_size=1, max_size=8, unique=True),
    st.floats(0, 2e9),
    st.integers(0, 2**32 - 1),
)
def test_what_the_fake_writes_is_read(names, stamp, seed):
    rows = np.random.default_rng(seed).normal(size=(3, len(names)))
    wanted = names[::-1]
    sample = JointStateReader(wanted).read(JointStateWriter(names).write(stamp, *rows))
    assert sample.stamp == pytest.approx(stamp, abs=1e-6)
    assert np.array_equal([sample.position, sample.velocity, sample.effort], rows[:, ::-1])


def test_an_address_names_domain_namespace_and_controller():
    bare = RosAddress.of("ros2://0/arm_controller")
    assert (bare.domain, bare.node, bare.name("joint_states")) == (0, "/arm_controller", "/joint_states")
    deep = RosAddress.of("ros2://42/cell_3/left/jtc,beside=move_group,beside=/rviz")
    assert (deep.domain, deep.node, deep.name("joint_states")) == (42, "/cell_3/left/jtc", "/cell_3/left/joint_states")
    assert deep.action == "/cell_3/left/jtc/follow_joint_trajectory"
    assert deep.beside == ("move_group", "/rviz")


@pytest.mark.parametrize(
    "address",
    [
        "",
        "127.0.0.1:9100",
        "ros2://",
        "ros2://0",
        "ros2://0/",
        "ros2://x/jtc",
        "ros2://233/jtc",
        "ros2://0/a b",
        "ros2://0/1a",
    ],
)
def test_other_addresses_are_refused(address):
    with pytest.raises(ConfigurationError, match=r"ros2://DOMAIN/NAMESPACE/CONTROLLER is expected"):
        RosAddress.of(address)


@pytest.mark.parametrize("names", [[], ["a", "a"], [f"j{k}" for k in range(65)]])
def test_joints_are_named_once(names):
    with pytest.raises(ProtocolError, match="joints"):
        joints_of(names)
