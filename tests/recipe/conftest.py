from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def recipe_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One path to write over: hypothesis wants no function-scoped fixture."""
    return tmp_path_factory.mktemp("recipe") / "recipe.yaml"
