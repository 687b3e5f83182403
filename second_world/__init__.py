"""A family of simulated worlds for the blind check, in MuJoCo: each draw has its own arm, friction, servo and recorder.

It is a process of its own (`python -m second_world`) and shares no physics with the fake controller or the diagnosis:
another engine, several laws for every effect, other motions. Nothing imports it.
"""
