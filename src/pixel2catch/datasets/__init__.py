"""Simulated throws and recorded deployments as data sets for imitation learning, in the format of LeRobot."""
