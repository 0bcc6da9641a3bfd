"""Policies under what the real world does and nominal simulation does not."""
