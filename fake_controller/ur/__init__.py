"""A Universal Robots controller on its published ports, with a script interpreter and an interpolator of its own."""
