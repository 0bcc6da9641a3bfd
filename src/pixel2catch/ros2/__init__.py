"""ROS 2 without an installation of it: messages as bytes, how they travel, and what a laboratory calls them.

The interface to the network and the clock are in `transport`, the one decoder of each message in `messages`,
the one reader of recordings in `bags`, the one map between our joints and those of the drivers in `profile`.
"""
