"""The pages of a calibration, a recalibration, a plan and a comparison, and their sections."""
