"""Logs made in the test."""

from tests.estimation.conftest import make_log

__all__ = ["make_log"]
