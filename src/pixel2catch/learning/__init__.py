"""Training with MAPPO, on one device or on several together."""
