"""Drivers: a folder a vendor or protocol. `base` has what they share."""
