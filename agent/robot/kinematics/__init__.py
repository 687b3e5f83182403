"""Forward and inverse kinematics of a serial arm, over many samples at once.

`kinematics_for` gives an arm with a spherical wrist (`spherical_wrist`) or with axes 2, 3 and 4 parallel
(`parallel_axes`, Universal Robots) its closed form, any other a numerical inverse (`numerical`). All are pure numpy.
Poses are those of the tool centre point (TCP) in the base frame.
"""
