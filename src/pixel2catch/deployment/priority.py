"""Which process comes first where there are too few cores, as far as the system lets us say so."""

import os
from contextlib import suppress

SERVO, BRAIN = -10, -8
"""Niceness of the servo, which is a real-time process where that is allowed, and of perception and policy.

Source: ours. Without it a busy machine takes the cores from the brain first: it works in one long piece.
"""

REAL_TIME_PRIORITY = 10
"""Priority among real-time processes. Source: ours."""


def set_niceness(niceness: int) -> None:
    """Give this thread, and those that it starts, their place among all others."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)


def be_real_time() -> None:
    """Come before all that are not."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME_PRIORITY))
