"""Pages in a real Chromium: sizes, schemes, paper, keyboard, screen readers, and every control used once."""

import os
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from agent.pages.elements import About, Bar, Bars, NextStep, Page, Section, Shade, Table, render, shaded_table
from agent.pages.plots import Panel, Plot, Series
from agent.pages.scene import ArmPoses, Scene
from agent.pipeline.reports import write_index
from tests.browser import differs, picture

WIDTHS = (390, 1440, 2560)
MOST_BYTES = 3_000_000


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with one of everything that a page may have."""
    t = np.linspace(0, 60, 30_000)
    wave = np.sin(t)[:, None] * [1.0, 2.0] + [0.0, 1.0]
    stack = [
        Series("gravity", wave[:, 0], "part"),
        Series("friction", wave[:, 1], "part", "#d55e00"),
        Series("measured", wave.sum(axis=1), colour="#808890"),
    ]
    bands = [
        Series("bounds", wave[:, 1] + 1, low=wave[:, 1] - 1),
        Series("dots", np.where(t % 1 < 0.1, wave[:, 1], np.nan), "points"),
        Series("dashes", wave[:, 1], "dashed"),
    ]
    panels = (
        Panel("first", "N·m", stack, joint="joint_1"),
        Panel("second", "N·m", bands, marks={"gate": 3.0}, joint="joint_2"),
    )
    every = slice(None, None, 20)
    dates = Panel("by date", "%", [Series(f"joint_{k}", wave[every, 0] * k, joint=f"joint_{k}") for k in (1, 2)])
    line = np.column_stack([np.cos(t[every]), np.sin(t[every]), 0 * t[every]])
    ends = np.arange(24.0).reshape(2, 2, 2, 3) / 24
    arm = ArmPoses(np.array([0.0, 1.0]), ends, np.array([0.1, 0.05]), ends.reshape(2, 4, 3))
    boxes = {"keep-out: table": (np.zeros(3), np.ones(3))}
    cells = np.array([[1.0, np.nan], [0.25, 0.5]])
    left = {"loop": np.abs(line[:, 0])}
    bars = Table("bars", ("joint", "error"), [(f"joint_{k}", Bars([Bar(0.0, k, "#2a86c8")])) for k in (1, 2)])
    titled = Table("titled", ("joint", "a", "b"), [("b", Shade(-0.5, "-0.5", "b, a: -0.5"), "")])
    shaded = shaded_table("cells", "Cells.", cells, ["slow", "fast"], ["joint_1", "joint_2"])
    scene = Scene("path", "The arm.", {"loop": line}, {"points": line[:3]}, boxes, arm, left, "left [%]")
    sections = (
        Section("Plots", ("Text.",), (Plot("waves", "Waves.", "time", panels, t, "s", columns=2),)),
        Section("Dates", (), (Plot("dates", "Dates.", "date", (dates,), 1.7e9 + 3600 * t[every], dates=True),)),
        Section("Map", (), (shaded, bars, titled)),
        Section("Scene", (), (scene, Table("table", ("joint", "value"), [("joint_1", "1.0"), ("joint_2", "2.0")]))),
    )
    about = About(
        "What is it?", (("Where", "A fact."),), (NextStep("do", "agent check recipe.yaml"),), (("robot", "arm"),)
    )
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(render(Page("Title", "An answer.", "good", sections, about)), encoding="utf-8")
    return path


def _serious(opened) -> list[str]:
    """What axe-core finds that keeps people from reading."""
    found = find_spec("axe_core_python")
    if found is None:
        pytest.skip("axe-core-python is missing: the page was not looked at for screen readers")
    (script,) = Path(found.origin).parent.rglob("axe.min.js")
    opened.tab.add_script_tag(path=str(script))
    result = opened.tab.evaluate("axe.run()")
    assert result["passes"], "it looked at something"
    return [
        f"{v['id']}: {v['nodes'][0]['html']}" for v in result["violations"] if v["impact"] in ("serious", "critical")
    ]


def _is_readable(browser, page: Path, width: int, scheme: str) -> None:
    with browser.page(page, width, scheme) as opened:
        opened.draw()
        assert opened.tab.evaluate("document.querySelectorAll('figure.plot:not(.drawn)').length") == 0
        beyond = opened.tab.evaluate("document.documentElement.scrollWidth - innerWidth")
        assert beyond <= 0, f"{page.name} is {beyond} px too wide at {width}"
        assert _serious(opened) == []
        assert (opened.console, opened.asked) == ([], [])


@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (2560, "light")])
def test_a_page_fits_the_screen_and_is_accessible(small: Path, browser, width: int, scheme: str):
    _is_readable(browser, small, width, scheme)


def test_stills_are_whole_on_a_phone_without_scripts(small: Path, browser):
    with browser.page(small, 400, script=False) as opened:
        stills = opened.tab.locator(".still").all()
        assert stills
        widths = [still.bounding_box()["width"] for still in stills]
        pictures = [opened.tab.locator(".still svg").nth(k).bounding_box()["width"] for k in range(len(stills))]
        assert max(widths) <= 400
        assert max(pictures) <= max(widths)


def test_a_page_without_contents_is_as_wide_as_one_with(browser, tmp_path: Path):
    page = tmp_path / "page.html"
    page.write_text(render(Page("Title", "An answer.", "good", [Section("One", ("Text. " * 40,))])), encoding="utf-8")
    with browser.page(page) as opened:
        assert opened.tab.locator("main").bounding_box()["width"] > 1000


def test_every_control_has_an_effect(small: Path, browser):
    with browser.page(small) as opened:
        opened.draw()
        tab = opened.tab
        for kind in (".legend button", ".zooms button", ".scene button", ".copy", ".bar button[aria-pressed]"):
            for button in tab.locator(kind).all():
                button.click()
        assert tab.locator(".copy").inner_text() == "copied"
        assert tab.locator(".bar button[aria-pressed=false]").count() == 4, "all joints are off"
        for button in tab.locator(".bar button[aria-pressed]").all():
            button.click()
        tab.locator(".scene input").fill("1")
        assert tab.locator(".scene .bar span").inner_text() == "1.0 s"
        tab.locator("nav a").first.click()
        tab.wait_for_function("location.hash == '#plots'", polling=50)  # nothing is loaded, and perhaps nothing painted
        assert opened.console == []


def test_plots_support_keyboard_zoom_and_linked_cursors(small: Path, browser):
    with browser.page(small) as opened:
        opened.draw()
        first, second = opened.tab.locator("figure[data-name=waves] .live .panel").all()
        first.locator(".canvas").focus()
        for key in ("ArrowRight", "+", "ArrowLeft"):
            opened.tab.keyboard.press(key)
        said = first.locator("[aria-live]").inner_text()
        assert said.startswith("time ")
        assert "N·m" in said
        assert "N·m" in second.locator(".legend b").first.inner_text(), "the other panel shows the same time"
        opened.tab.keyboard.press("0")
        assert opened.console == []


def test_without_scripts_and_in_print_plots_are_static_images(small: Path, browser):
    with browser.page(small, script=False) as opened:
        assert opened.tab.locator(".still svg:visible").count() == 3, "a panel each"
    with browser.page(small) as opened:
        opened.draw()
        assert opened.tab.locator(".still svg:visible").count() == 0
        opened.tab.emulate_media(media="print")
        assert opened.tab.locator(".still svg:visible").count() == 3, "a panel each"
        assert opened.tab.locator(".live:visible, nav:visible, button:visible").count() == 0


def test_a_click_offers_the_data_as_plain_text(small: Path, browser):
    with browser.page(small) as opened:
        with opened.tab.expect_download() as download:
            opened.tab.locator("a[download='waves.csv.gz']").click()
        text = Path(download.value.path()).read_text(encoding="utf-8")
        header, *rows = text.splitlines()
        assert header.startswith("time [s],first gravity [N·m]")
        assert 1000 < len(rows) < 30_000, "thinned for the screen"


@pytest.mark.parametrize(("width", "look"), [(390, "dark"), (1440, "light"), (1440, "print"), (2560, "light")])
def test_a_page_matches_its_stored_screenshot(small: Path, browser, width: int, look: str):
    """`KEEP_PICTURES=1` keeps what it looks like now; look at the page itself before."""
    file = Path(__file__).with_name("pictures") / f"{width}_{look}.png"
    with browser.page(small, width, "dark" if look == "dark" else "light") as opened:
        opened.draw()
        if look == "print":
            opened.tab.emulate_media(media="print")
        now = picture(opened)
        if os.environ.get("KEEP_PICTURES"):
            Image.fromarray(now.round().astype(np.uint8)).save(file, optimize=True)
        kept = np.asarray(Image.open(file), dtype=float)
        assert differs(now, kept) == ""
        if look == "light":
            opened.tab.add_style_tag(content="canvas { visibility: hidden }")
            assert differs(picture(opened), kept).startswith("off by")


def test_thinning_keeps_the_extremes(small: Path):
    from agent.pages.plots import thinned

    rng = np.random.default_rng(0)
    values = rng.normal(size=(50_000, 3))
    values[rng.integers(50_000, size=3), [0, 1, 2]] = 100.0
    kept = thinned(values)
    assert len(kept) <= 2500
    assert np.all(values[kept].max(axis=0) == values.max(axis=0))
    assert np.all(values[kept].min(axis=0) == values.min(axis=0))
    assert kept[0] == 0
    assert kept[-1] == 49_999


@pytest.mark.verify
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_all_pages_fit_and_are_accessible(calibrated: Path, write_runs, browser, width: int, scheme: str, measured):
    (calibration,) = calibrated.glob("logs/*/report.html")
    for page in (calibration, write_index(write_runs(20, 2, wear=1))):
        size = page.stat().st_size
        measured(f"{page.name} at {width} px, {scheme}", size / 1e6, "MB", "at most 3 MB", size < MOST_BYTES)
        assert size < MOST_BYTES
        _is_readable(browser, page, width, scheme)
