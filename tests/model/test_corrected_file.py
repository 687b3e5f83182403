"""A simulator written back corrected: the same file with other numbers."""

import json
import re
from xml.etree.ElementTree import SubElement

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.robot import ParameterLayout
from agent.simulators import load_simulator, write_corrected
from agent.simulators.corrected.xml_document import XmlDocument
from tests.conftest import loaded
from tests.model.correcting import (
    BOOM,
    MJCF,
    NAMES,
    PATHS,
    URDF,
    corrected,
    entry,
    motion,
    moved,
    simulator,
    torque_of_file,
)


@pytest.mark.parametrize("kind", PATHS)
def test_changes_only_released_values_and_lists_every_change(kind, tmp_path):
    given = simulator(tmp_path, kind)
    change = moved(given, links=[1], rotors=[0])
    effects = [entry("stribeck", "pan", speed=0.2, shape=2, rise=1.5)]
    found = corrected(given, effects, links=[1], rotors=[0], friction=[2], change=change)
    out = tmp_path / f"fixed{given.arm.path.suffix}"
    written = write_corrected(given, found, out)
    time, q, qd, qdd = motion()
    torque = torque_of_file(out, loaded(written[-1]), q, qd, qdd)
    expected = found.model.predict(q, qd, qdd, time)
    assert np.abs(torque - expected).max() < 1e-6 * np.abs(expected).max()
    wanted = given.model.predict(q, qd, qdd, time) + given.model.rigid.torque(
        q, qd, qdd, change[: len(given.model.independent)]
    )
    rest = expected - wanted
    assert np.abs(rest[:, 1]).max() < 1e-3 * np.abs(expected).max()  # bodies as the fit had them, no friction
    document = json.loads((tmp_path / "fixed.changes.json").read_text())
    assert {(c["element"], c["attribute"]) for c in document["changes"]} >= {
        ("joint turn", "frictionloss"),
        ("joint turn", "damping"),
    }
    assert {c["element"].split()[1] for c in document["changes"]} == (
        {"pan", "turn", "boom"} if kind == "mjcf" else {"turn", "weight"}
    )
    assert all(c["reason"] == "because" and c["old"] != c["new"] for c in document["changes"])
    assert document["effects"][0]["effect"] == "stribeck"


def test_keeps_the_text_of_an_mjcf(tmp_path):
    given = simulator(tmp_path, "mjcf")
    found = corrected(given, friction=[0], change=moved(given))
    out = tmp_path / "fixed.xml"
    written = write_corrected(given, found, out)
    assert [path.name for path in written] == ["fixed.xml", "fixed.changes.json"]
    joint = '<joint name="pan" class="big" axis="0 0 1"   range="-170 170" />'
    new = joint.replace(" />", ' frictionloss="2.3" damping="1.7" />')
    assert out.read_text() == MJCF.replace(joint, new)


def test_writes_a_changed_include_next_to_the_file(tmp_path):
    given = simulator(tmp_path, "mjcf")
    found = corrected(given, links=[2], change=moved(given, links=[2]))
    files = {path.name: path.read_text() for path in write_corrected(given, found, tmp_path / "fixed.xml")}
    assert set(files) == {"fixed.xml", "fixed_boom.xml", "fixed.changes.json"}
    assert files["fixed.xml"] == MJCF.replace('"boom.xml"', '"fixed_boom.xml"')
    assert files["fixed_boom.xml"].count("<inertial") == 2
    assert (tmp_path / "boom.xml").read_text() == BOOM


def test_keeps_the_text_of_a_urdf(tmp_path):
    given = simulator(tmp_path, "urdf")
    found = corrected(given, friction=[0, 1], change=moved(given))
    write_corrected(given, found, tmp_path / "fixed.urdf")
    text = URDF.replace('damping="1.5" friction="0.5"', 'damping="1.7" friction="0.8"')
    first = '<joint name="lift" type="revolute">'
    text = text.replace(first, f'{first}\n  <dynamics damping="0.2" friction="0.3"/>')
    assert (tmp_path / "fixed.urdf").read_text() == text


@pytest.mark.parametrize(("folder", "file"), [(' meshdir="parts"', "cube.obj"), ("", "parts/cube.obj")])
def test_a_file_in_another_folder_still_finds_its_meshes(tmp_path, folder, file):
    import mujoco

    given = simulator(tmp_path, "mjcf")
    (tmp_path / "parts").mkdir()
    cube = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    (tmp_path / "parts" / "cube.obj").write_text(cube)
    mesh = f'<asset><mesh name="cube" file="{file}" scale=".1 .1 .1"/></asset>'
    text = MJCF.replace('angle="degree"', f'angle="degree"{folder}').replace("<default>", f"{mesh}<default>", 1)
    (tmp_path / "arm.xml").write_text(text)
    given = load_simulator(tmp_path / "arm.xml", None, NAMES)
    (tmp_path / "out").mkdir()
    write_corrected(given, corrected(given, friction=[0], change=moved(given)), tmp_path / "out" / "fixed.xml")
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "fixed.xml")).dof_frictionloss[0] == 2.3


def test_refuses_to_write_non_physical_bodies(tmp_path):
    given = simulator(tmp_path, "urdf")
    lighter = -4 * moved(given, links=[2])
    found = corrected(given, links=[2], change=lighter)
    assert "could not exist" in " ".join(found.notes)
    write_corrected(given, found, tmp_path / "fixed.urdf")
    assert "could not exist" in (tmp_path / "fixed.changes.json").read_text()
    mass = float(re.search(r'"c".*?mass value="([^"]*)"', (tmp_path / "fixed.urdf").read_text(), re.S)[1])
    assert 0 < mass < 0.5


def test_writes_a_rotor_as_armature_if_a_link_fits_significantly_worse(tmp_path):
    """A hundredth of what moving a link gained may be far more than what noise leaves."""
    given = simulator(tmp_path, "urdf")
    turning = np.zeros(len(given.model.values))
    turning[: len(given.model.independent)] = given.model.projection @ np.eye(33)[30 + 2] * 0.1
    heavier = 5 * moved(given, links=[2])
    rough, exact = (corrected(given, links=[2], change=turning + heavier, unexplained=left) for left in (1e6, 10.0))
    assert rough.arm.armature[2] == 0
    assert exact.arm.armature[2] == pytest.approx(0.1, rel=0.4)


def test_a_file_that_cannot_be_edited_is_refused_and_nothing_is_written(tmp_path):
    given = simulator(tmp_path, "mjcf")
    (tmp_path / "arm.xml").write_text(MJCF.replace('angle="degree"', 'angle="degree" boundmass="5"'))
    given = load_simulator(tmp_path / "arm.xml", None, NAMES)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(Exception, match=r"nothing was written.*differ by"):
        write_corrected(given, corrected(given, links=[2], change=-moved(given, links=[2])), tmp_path / "fixed.xml")
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize("text", ['<a b=\'1\' c="x > y"><!-- b="2" --><d/>\n  <e  /></a>', "<a>\n  <b x = '1'/>\n</a>"])
def test_changes_only_the_edited_bytes_of_an_xml_file(text):
    xml = XmlDocument(text.encode())
    assert xml.changed() == text.encode()
    first = xml.root[0]
    first.set("new", 'a"<b')
    SubElement(first, "in")
    again = XmlDocument(xml.changed()).root[0]
    assert again.get("new") == 'a"<b'
    assert [element.tag for element in again] == ["in"]
    first.attrib.pop("new")
    first.clear()
    with pytest.raises(ValueError, match="UTF-8"):
        XmlDocument(text.encode("utf-16"))


def test_elements_get_another_name_at_both_ends_and_all_else_stays():
    text = '<a><!-- <b/> -->\n <b k="1"  l=\'b>\' />\n <b k="2"><b/></b ><bb/></a>'
    xml = XmlDocument(text.encode())
    for element in xml.root.findall("b"):
        element.tag = "general"
        element.set("m", "3")
    assert xml.changed().decode() == (
        '<a><!-- <b/> -->\n <general k="1"  l=\'b>\' m="3" />\n <general k="2" m="3"><b/></general ><bb/></a>'
    )


def test_a_format_that_the_simulator_does_not_have_is_refused(tmp_path):
    from agent.pipeline.gap.corrected_output import check_simulator_out

    simulator(tmp_path, "urdf")
    with pytest.raises(InputError, match="here it is a URDF"):
        check_simulator_out(tmp_path / "arm.urdf", tmp_path / "fixed.xml", [])
    with pytest.raises(InputError, match="a model file"):
        check_simulator_out(tmp_path / "model.json", tmp_path / "fixed.urdf", [])
    code = tmp_path / "fixed_effects.py"
    code.write_text("")
    with pytest.raises(InputError, match="fixed_effects"):
        check_simulator_out(tmp_path / "arm.urdf", tmp_path / "fixed.urdf", [code])


@pytest.mark.parametrize("kind", PATHS)
def test_a_rotor_found_as_a_link_becomes_armature_and_no_link_of_tons(tmp_path, kind):
    given = simulator(tmp_path, kind)
    layout = ParameterLayout.of(given.model.robot)
    change = np.zeros(len(given.model.values))
    change[: len(given.model.independent)] = 2.0 * given.model.projection[:, layout.rotors][:, 1]
    found = corrected(given, links=(1,), change=change)
    assert found.arm.carrying[1].own[0] < 3 * given.arm.carrying[1].own[0]
    q, qd, qdd = np.random.default_rng(2).uniform(-1, 1, (3, 20, 3))
    time = np.arange(20.0)
    gained = found.model.predict(q, qd, qdd, time) - given.model.predict(q, qd, qdd, time)
    np.testing.assert_allclose(gained[:, 1], 2.0 * qdd[:, 1], atol=0.05)
    assert found.arm.armature[1] == pytest.approx(given.arm.armature[1] + 2.0, abs=0.2)
