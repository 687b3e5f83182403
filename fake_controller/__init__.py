"""An emulated robot controller, met at the wire. `python -m fake_controller --help` runs it as a process of its own."""
