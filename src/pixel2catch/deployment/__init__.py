"""From the simulator to the laboratory: the policy at 30 Hz, and the servo that guards the robot at 500 Hz.

`controller` has the observation builder, policy and action map of training; `servo_core` decides what of its
targets reaches the robot. Neither knows ROS, a clock or a robot: both are functions of what is given to them.
`servo_process` runs the latter in a process of its own, on the wire that a `profile` describes.
"""
