"""The calibration of a lens."""
