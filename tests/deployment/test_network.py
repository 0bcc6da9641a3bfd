"""The network that commands join: by default this machine only."""

import subprocess
import sys
from pathlib import Path

import pytest

from domains import PATIENCE
from pixel2catch.cli.deploy import Deploy
from pixel2catch.cli.link import Link
from pixel2catch.cli.operate import Operate
from pixel2catch.cli.record import Record
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import ANY, LOOPBACK, ROS, RealClock


def test_commands_join_this_machine_only_by_default():
    links = (
        Deploy().link,
        Record(trajectory=Path("a"), out=Path("b")).link,
        Operate(device=Path("a")).network,
    )
    assert {link.network for link in links} == {LOOPBACK}


def test_only_the_twin_needs_no_identified_dynamics():
    """If a robot may be connected, commands are no faster than its joints."""
    profile = Profile.load("ur5e_allegro_v4")
    twin = Link().limits(profile).joints
    for link in (Link(network=ANY), Link(network=ROS)):
        assert not link.is_twin
        assert (link.limits(profile).joints.speed < twin.speed).all()


def test_time_passes_while_the_machine_is_suspended():
    """In a namespace of Linux whose clock is 1,000 s ahead."""
    script = "from pixel2catch.ros2.transport import RealClock; print(RealClock(0.5).now())"
    ahead = ["unshare", "--time", "--boottime", "1000", sys.executable, "-c", script]
    before = RealClock(0.5).now()
    found = subprocess.run(ahead, capture_output=True, text=True)
    if found.returncode:
        pytest.skip(f"no namespaces of time here: {found.stderr}")
    assert 500.0 <= float(found.stdout) - before < 500.0 + PATIENCE
