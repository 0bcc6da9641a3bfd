"""A DDS domain for the tests of this process: no other test is on it, nor any program of this machine."""

import os
import socket
from functools import cache

FIRST_PORT, PORTS = 7410, 250
"""Port of the first participant of domain 0, and how many ports a domain has. Source: DDS-RTPS."""


@cache
def own_domain() -> str:
    """A ROS_DOMAIN_ID whose first ports are free; others that look at the same time begin elsewhere."""
    for number in range(200):
        domain = 1 + (os.getpid() + 7 * number) % 200
        try:
            for port in range(4):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
                    free.bind(("127.0.0.1", FIRST_PORT + PORTS * domain + port))
        except OSError:
            continue
        return str(domain)
    raise RuntimeError("no DDS domain is free")


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
