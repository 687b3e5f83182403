"""The controller link.

`protocol` says what a driver must do, and `conformance` tests it. A new vendor's driver is a folder of `transports`,
with the format of its wire as data in `wire`, and a line of `registry`; docs/how-to-driver.md has the steps.

Nothing is imported here: whoever only handles `drivers.errors` does not pay for the rest.
"""
