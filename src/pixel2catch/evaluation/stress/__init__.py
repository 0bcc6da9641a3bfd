"""Disturbances that training lacks: the suite, and which of them a policy was trained on."""
