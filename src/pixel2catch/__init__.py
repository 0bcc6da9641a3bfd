"""Catch thrown objects with an arm and a hand from one RGB camera."""
