"""Forward and inverse kinematics of a serial arm, over many samples at once.

`kinematics_for` gives an arm with a spherical wrist its closed form (`spherical_wrist`), any other a numerical inverse
(`numerical`). Both are pure numpy. Poses are those of the tool centre point (TCP) in the base frame.
"""
