"""Perception and policy on a robot at 30 Hz: control loop, operator, recordings, laboratory checks."""
