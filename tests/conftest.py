"""Fixtures for all tests."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[1] / "../shared/data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of measured data beside the checkout; skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("measured data is not here: ../shared/data beside the checkout is missing")
    return SHARED


@pytest.fixture
def measured(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Note a figure for docs/measured.md: `measured("what", value, "unit", "at most 2 %", ok)`.

    It only writes where `make verify` asked for it; the assertion stays in the test.
    """

    def note(what: str, value: float | str, unit: str = "", target: str = "", ok: bool = True) -> None:
        path = os.environ.get("CALIBRATION_FIGURES")
        if path:
            entry = {"what": what, "value": value, "unit": unit, "target": target, "ok": bool(ok)}
            with open(path, "a", encoding="utf-8") as file:
                file.write(json.dumps({"test": request.node.nodeid, **entry}) + "\n")

    return note
