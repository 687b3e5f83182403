"""The driver for COMAU controllers with the open programs of CNR, docs/real-robot.md."""
