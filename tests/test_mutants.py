"""No number of a fit, a verdict or a page can be changed unnoticed."""

import pytest

from tests.mutants import EQUIVALENT, NARROW, PACKAGES, ROOT, modules, survivors


def test_modules_and_tests_that_are_named_exist():
    assert {*EQUIVALENT, *NARROW} <= set(modules())
    assert [
        test for tests in (*PACKAGES.values(), *NARROW.values()) for test in tests if not (ROOT / test).exists()
    ] == []


@pytest.mark.verify
@pytest.mark.parametrize("module", modules())
def test_every_change_of_a_number_is_noticed(module, measured):
    tried, alive = survivors(module)
    measured(f"{module}: changes noticed by its tests", f"{tried - len(alive)} of {tried}", "", "all", not alive)
    assert not alive, "\n".join(alive)
