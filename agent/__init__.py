"""Local calibration of industrial robot dynamics, and diagnosis of the sim-to-real gap."""
