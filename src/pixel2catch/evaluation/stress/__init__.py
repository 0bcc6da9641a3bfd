"""Disturbances that training lacks: the suite, what a policy was trained on, and the report."""
