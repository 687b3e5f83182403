"""An effect is one class in one file: nothing else knows its name, and others can install more."""

import logging
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest

import agent.diagnosis
import agent.pages
from agent.diagnosis import check_effects, diagnose, extended_model
from agent.estimation import estimate
from agent.model import CATALOGUE, IdentifiedModel
from agent.model.effects import GROUP
from agent.pages.diagnosis.page import diagnosis_report
from agent.validation import validate
from fake_controller.actuation import EFFECTS
from fake_controller.plant import Plant
from tests.small_arms import make_arm, record

ROOT = Path(__file__).resolve().parents[2]
#: What the documentation shows: an effect that pulls a joint to an angle, with a grid of angles and one width.
HOW_TO = (ROOT / "docs/how-to-effect.md").read_text(encoding="utf-8")
FAMILIES = {"friction", "transmission", "load", "measurement", "path"}
SOURCE = textwrap.dedent(HOW_TO.split("```python\n")[1].split("```")[0])


@pytest.fixture
def plug_in(tmp_path, monkeypatch):
    """`plug_in(name, source)` installs a distribution with one effect of that name."""

    def install(name: str, source: str) -> None:
        (tmp_path / f"effect_{name}.py").write_text(source, encoding="utf-8")
        info = tmp_path / f"effect_{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: effect-{name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = effect_{name}:Magnet\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        CATALOGUE.reload()

    yield install
    monkeypatch.undo()
    CATALOGUE.reload()


def test_no_effect_name_appears_in_the_procedure_and_its_pages():
    folder = Path(agent.diagnosis.__file__).parent
    pages = Path(agent.pages.__file__).parent
    named = re.compile("|".join(rf"""["']{name}["']""" for name in CATALOGUE))
    found = {
        path.name: named.findall(path.read_text(encoding="utf-8"))
        for path in [*folder.glob("*.py"), *pages.rglob("*.py")]
    }
    assert {name: hits for name, hits in found.items() if hits} == {}


def test_every_effect_describes_itself():
    for effect in CATALOGUE.values():
        assert effect.family in FAMILIES
        assert effect.shows_in == ("path" if effect.family == "path" else "torque")
        assert all((effect.phrase, effect.experiment.motion, effect.practical > 0))
    assert len({effect.phrase for effect in CATALOGUE.values()}) == len(CATALOGUE)


def test_every_effect_meets_another_formula():
    """That of the emulator, or that of a test with its name."""
    own = {path.stem.removeprefix("test_") for path in Path(__file__).parent.rglob("test_*.py")}
    assert {effect.name for effect in CATALOGUE.built_in} <= EFFECTS.keys() | own


def test_finds_reports_and_saves_an_installed_effect(plug_in, tmp_path):
    plug_in("magnet", SOURCE)
    check_effects(["magnet"])
    robot = make_arm("RR")

    def logs(pull: float) -> list:
        made = []
        for seed in (21, 22) if pull else (11, 12):
            log = record(Plant(robot, seed=3), f"motion_{seed}", seed)
            away = log.position[:, 1] - 0.25
            log.effort[:, 1] += pull * away * np.exp(-((away / 0.1) ** 2))
            made.append(log)
        return made

    found = diagnose(robot, logs(400.0), estimate(robot, logs(0.0)))
    cause = found.result["causes"][0]
    assert (cause["effect"], cause["joints"]) == ("magnet", ["joint_2"])
    assert cause["parameters"]["strength"] == pytest.approx(400.0, rel=0.1)
    assert "a magnet pulls the joint" in diagnosis_report(found)
    extended_model(found).save(tmp_path / "model.json")
    better = validate(IdentifiedModel.load(tmp_path / "model.json"), logs(400.0)).overall
    assert max(better.rmse) < 0.5 * max(validate(found.dataset.model, logs(400.0)).overall.rmse)


@pytest.mark.parametrize(
    ("name", "source", "told"),
    [
        ("broken", "raise RuntimeError('no such file')", "no such file"),
        ("payload", SOURCE.replace("magnet", "payload"), "the name is taken"),
        ("mute", SOURCE.replace('phrase = "a magnet pulls the joint"', ""), "lacks phrase"),
        (
            "unknown",
            SOURCE.replace("linear =", 'numbers = "magnets"\n    linear ='),
            "'magnets' is not a valid FileNumbers",
        ),
        ("other", SOURCE, "calls itself 'magnet'"),
        ("none", "class Magnet: pass", "is no agent.model.effects.Effect"),
    ],
)
def test_an_invalid_plug_in_effect_is_reported_and_left_out(plug_in, caplog, name, source, told):
    usual = list(CATALOGUE)
    with caplog.at_level(logging.WARNING):
        plug_in(name, source.replace('"magnet"', f'"{name}"') if name == "mute" else source)
        assert list(CATALOGUE) == usual
    assert told in caplog.text
