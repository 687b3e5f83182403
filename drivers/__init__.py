"""The controller link. `drivers.protocol` says what every driver offers, `drivers.registry` creates one by name.

Nothing is imported here: whoever only handles `drivers.errors` does not pay for the rest.
"""
