"""From logs to what a model is fitted to: one clock, smoothed motion, and torque and columns through one filter."""
