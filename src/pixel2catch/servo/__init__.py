"""The servo that guards the robot at 500 Hz.

`core` decides what of the policy's targets reaches the robot: a function of what is given to it, which knows
neither ROS nor a clock nor a robot. `process` runs it in a process of its own, on the wire of a profile.
"""
