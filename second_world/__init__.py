"""A second world for the blind check: arms in MuJoCo with a servo, friction, motions and recorders of their own.

It is a process of its own (`python -m second_world`) and shares no physics with the fake controller or the diagnosis:
another engine, effects written as other laws, other motions. Nothing imports it.
"""
