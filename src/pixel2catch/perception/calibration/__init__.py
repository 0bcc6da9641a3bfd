"""Calibration of a camera: the lens, and where it stands, from images of a printed board."""
