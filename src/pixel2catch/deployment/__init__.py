"""From the simulator to the laboratory: perception and policy at 30 Hz.

`policy_pipeline` has the observation builder, policy and action map of training; `control_loop` runs it on
the messages of a robot, which the `servo` guards.
"""
