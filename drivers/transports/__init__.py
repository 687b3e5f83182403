"""Drivers, one folder per vendor or protocol. `base` has what they share."""
