"""The emulator's world for the blind check: which effects are withheld, and the runs that hold them.

A process of its own, `python -m fake_controller.withheld`. It knows what is built in; the agent does not.
"""
