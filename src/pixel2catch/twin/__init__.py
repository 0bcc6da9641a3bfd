"""The digital twin of the lab: on the wire it is robot, hand, camera and thrower; behind it is the simulator.

`Lab` is the physics and the judge, `UrDriver` and `HandDriver` are what the robots' drivers do with commands,
`rendering.camera.RoomCamera` draws what the camera sees, `Wires` puts all of it on the topics of a robot
profile. What training adds to actions, noise and bias, is left out: a robot does what it is told.
"""
