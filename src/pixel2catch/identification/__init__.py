"""From recorded motion to the joint dynamics of the simulator."""
