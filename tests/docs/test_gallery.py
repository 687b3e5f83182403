"""The gallery has the sections that its script writes, with their sources, licences and small pictures."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.conftest import loaded

DOCS = Path(__file__).resolve().parents[2] / "docs"
LARGEST = 60_000  # bytes of a picture


@pytest.fixture
def maker(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    return loaded(DOCS / "make_gallery.py")


def test_every_arm_has_its_source_its_licence_and_its_pictures(maker):
    introduction, *sections = maker.PAGE.read_text(encoding="utf-8").split("\n## ")
    found = {text.partition("\n")[0]: text for text in sections}
    assert list(found) == [*maker.ARMS, maker.SIMULATED]
    assert "**Simulated**" in found[maker.SIMULATED]
    for name in maker.ARMS:
        source, licence = maker.source_of(name)
        assert licence in ("Apache-2.0", "MIT")
        assert f"Source: {source}. Licence: {licence}." in found[name]
        assert f"| [{name}](#{name.lower()}) | {licence} | " in introduction
    linked = [set(re.findall(r"\]\(gallery/(\S+)\)", text)) for text in found.values()]
    assert linked == [{f"{name.lower()}_{plot}.svg" for plot in ("prediction", "friction")} for name in found]
    assert {path.name for path in maker.PICTURES.iterdir()} == set().union(*linked)
    for path in maker.PICTURES.iterdir():
        assert path.stat().st_size < LARGEST
        assert ElementTree.parse(path).getroot().tag.endswith("svg")


def test_without_the_logs_nothing_is_written(maker, monkeypatch, tmp_path: Path, capsys):
    monkeypatch.setattr(maker, "TABLES", [tmp_path / "missing.csv"])
    monkeypatch.setattr(maker, "PAGE", tmp_path / "gallery.md")
    monkeypatch.setattr(maker, "PICTURES", tmp_path / "gallery")
    maker.main()
    assert "missing.csv is missing; docs/real-data.md names the sources" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
