"""A headless Chromium for tests of pages; what needs it skips, and says so, where there is none."""

from __future__ import annotations

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
