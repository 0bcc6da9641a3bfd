"""Robots as data: one folder a robot part, with its MJCF and what MJCF does not say."""
