"""A headless Chromium for tests of pages; without it, these tests skip with a message."""

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

_OPTIONS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run")
_SCROLL = """async () => {
  for (const figure of document.querySelectorAll("figure.plot")) {
    figure.scrollIntoView();
    for (let k = 0; k < 200 && !figure.classList.contains("drawn"); k++) await new Promise(r => setTimeout(r, 10));
  }
  scrollTo(0, 0);
}"""


@dataclass
class Opened:
    """A page in a tab: what its console said, and which addresses it asked for."""

    tab: Any
    console: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)

    def draw(self) -> None:
        """Scroll through the page until all its plots are drawn."""
        self.tab.evaluate(_SCROLL)


def picture(opened: Opened, cell: int = 12) -> Any:
    """The whole page as rendered (rows, columns): mean grey, 0 to 255, of squares with a side in pixels.

    Squares as large as a letter: a page keeps its picture where letters have another shape, and loses it where
    anything is missing, moved or of another colour.
    """
    import numpy as np
    from PIL import Image

    grey = np.asarray(Image.open(io.BytesIO(opened.tab.screenshot(full_page=True))).convert("L"), dtype=float)
    rows, columns = (size // cell for size in grey.shape)
    return grey[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell).mean(axis=(1, 3))


def differs(now: Any, kept: Any, window: int = 6) -> str:
    """How a picture differs from a stored one; empty if it is the same page, even with other fonts.

    Other fonts changed the mean of a window of squares by up to 23, a missing curve by 35 and more.
    """
    import numpy as np

    if now.shape[1] != kept.shape[1] or abs(len(now) - len(kept)) > 2:
        return f"its size is {now.shape}, and was {kept.shape} squares"
    rows = min(len(now), len(kept))
    sums = np.pad(np.abs(now[:rows] - kept[:rows]), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    means = sums[window:, window:] - sums[:-window, window:] - sums[window:, :-window] + sums[:-window, :-window]
    row, column = np.unravel_index(means.argmax(), means.shape)
    worst = float(means.max()) / window**2
    return f"off by {worst:.0f} of 255 at square {row}, {column}" if worst > 28 else ""


class Browser:
    """One browser for a whole session of tests."""

    def __init__(self, chromium: Any) -> None:
        self._chromium = chromium

    @contextmanager
    def page(self, path: Path, width: int = 1440, scheme: str = "light", script: bool = True) -> Iterator[Opened]:
        """A page opened at a width [px] in the light or dark scheme, with or without script."""
        size = {"width": width, "height": 900}
        context = self._chromium.new_context(viewport=size, color_scheme=scheme, java_script_enabled=script)
        opened = Opened(context.new_page())
        opened.tab.on("console", lambda message: opened.console.append(message.text))
        opened.tab.on("pageerror", lambda error: opened.console.append(str(error)))
        opened.tab.on(
            "request", lambda r: None if r.url.startswith(("file:", "data:", "blob:")) else opened.asked.append(r.url)
        )
        try:
            opened.tab.goto(path.resolve().as_uri())
            yield opened
        finally:
            context.close()


@contextmanager
def browser() -> Iterator[Browser]:
    """Starts it, and ends it."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("Chromium is not installed here: pages were not opened in a browser")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: no page was opened")
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=program, args=list(_OPTIONS))
        try:
            yield Browser(chromium)
        finally:
            chromium.close()
