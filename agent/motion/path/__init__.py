"""Geometry of a path and its speed profile."""

from agent.motion.path import rotation

__all__ = ["rotation"]
