"""Logs of positions and commands without torque, judged by the simulator's own motion (output error)."""
