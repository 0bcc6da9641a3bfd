"""Policies judged by the physics of other engines."""
