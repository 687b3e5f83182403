"""The gap between model and robot: diagnosis, further motions, and the corrected simulator."""
