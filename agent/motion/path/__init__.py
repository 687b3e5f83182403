"""Geometry of a path and its speed profile."""

from agent.motion import rotation

__all__ = ["rotation"]
