"""An emulated robot controller, met at the wire. `python -m fake_controller --help` runs it as a process of its own.

One controller stands behind every wire of `servers`. `ur` is another controller, with a language and ports of its own.
"""
