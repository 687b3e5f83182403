"""Corrects a simulator: edits numbers of its file, and writes other effects to a file next to it."""
