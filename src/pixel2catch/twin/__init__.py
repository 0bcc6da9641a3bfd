"""The digital twin of the lab: on the wire it is robot, hand, camera and thrower; behind it is the simulator.

`SimulatedLab` is physics and throws, `ArmDriver` and `HandDriver` are what the drivers do with commands,
`RoomCamera` draws what the camera sees, `LabNode` puts all of it on the topics of a profile. What training
adds to actions, noise and bias, is left out: a robot does what it is told.
"""
