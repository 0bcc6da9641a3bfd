"""A DDS domain that this process has alone, a port, a full disk, and patience with other processes."""

import fcntl
import os
import resource
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

FIRST_PORT, PORTS = 7410, 250
"""Port of the first participant of domain 0, and how many ports a domain has. Source: DDS-RTPS."""

DOMAINS = range(1, 201)  #: Those that tests take; programs are on 0 where nothing is said.
PATIENCE = 600.0  #: Time after which something that another process does counts as failed [s].


@cache
def own_domain() -> str:
    """A ROS_DOMAIN_ID that this process has alone until its end: it holds a lock on a file of that number."""
    first = os.getpid() % len(DOMAINS)
    for domain in (*DOMAINS[first:], *DOMAINS[:first]):
        if _is_locked(domain) and _is_quiet(domain):
            return str(domain)
    raise RuntimeError("no DDS domain is free")


def _is_locked(domain: int) -> bool:
    """Whether the lock of a domain is ours; the system takes it back when this process ends."""
    path = Path(tempfile.gettempdir()) / f"pixel2catch-test-domain-{domain}-{os.getuid()}.lock"
    file = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        return False
    return True


def _is_quiet(domain: int) -> bool:
    """Whether nobody listens on the ports of the first participants, be it a program without a lock."""
    try:
        for port in range(4):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
                free.bind(("127.0.0.1", FIRST_PORT + PORTS * domain + port))
    except OSError:
        return False
    return True


@contextmanager
def full_disk(limit: int = 0) -> Iterator[None]:
    """No file can grow beyond the limit [bytes], as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def until(is_true: Callable[[], Any], go_on: Callable[[], Any] = lambda: None) -> None:
    """Wait until something is true, such as that the network has found an endpoint; go on meanwhile."""
    end = time.monotonic() + PATIENCE
    while not is_true():
        assert time.monotonic() < end
        go_on()
        time.sleep(0.001)
