"""The command line: parse, call, print, exit code. No mathematics."""

from agent.cli.entry_point import main
