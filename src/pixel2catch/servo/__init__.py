"""The servo that guards the robot at 500 Hz.

`tick` decides which part of the policy's targets reaches the robot: a function of its inputs, without ROS,
clock or robot. `process` runs it on the topics of a profile, in a process of its own.
"""
