"""Runs with a withheld effect, diagnosed without the key, then scored."""

from agent.blind_check.check import BlindCheck

__all__ = ["BlindCheck"]
