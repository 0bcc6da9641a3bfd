"""ROS 2 without an installation of it: messages, transports, recordings and robot profiles.

`transport` has the interface to network and clock, `messages` the only encoder and decoder of each message,
`bags` the only reader of recordings, `profile` the names and order of a driver's joints.
"""
