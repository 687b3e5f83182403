"""Corrects a simulator: changes numbers of its file in place, and writes other effects to a file next to it."""
