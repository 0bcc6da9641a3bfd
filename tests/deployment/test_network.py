"""Which network the commands join: this machine only, unless they are told of another one."""

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from domains import PATIENCE
from pixel2catch.cli.deploy import Deploy
from pixel2catch.cli.link import Link
from pixel2catch.cli.main import main
from pixel2catch.cli.operate import Operate
from pixel2catch.cli.record import Record
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import ANY, LOOPBACK, RealClock

INTERFACES = [name for _, name in socket.if_nameindex()]
COMMANDS = (["deploy"], ["record", "motion.npz", "--out", "tape"], ["operate", "/dev/null"])


def test_nobody_joins_more_than_this_machine_by_default():
    links = (
        Deploy().link,
        Record(trajectory=Path("a"), out=Path("b")).link,
        Operate(device=Path("a")).network,
    )
    assert {link.network for link in links} == {LOOPBACK}


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
def test_an_interface_that_there_is_not_is_refused_at_once(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """And those that there are, are named."""
    monkeypatch.chdir(tmp_path)
    Path("motion.npz").touch()
    assert main([*command, "--network", "eth99"]) == 2
    said = capsys.readouterr().err
    assert "network 'eth99'" in said
    assert all(name in said for name in (LOOPBACK, ANY, *INTERFACES))


def test_only_the_twin_needs_no_identified_dynamics():
    """Where a robot may be heard, commands are no faster than its joints may be."""
    profile = Profile.load("ur5e_allegro_v4")
    twin = Link().limits(profile).joints
    for link in (Link(network=ANY), Link(transport="ros")):
        assert not link.is_twin
        assert (link.limits(profile).joints.speed < twin.speed).all()


def test_time_passes_while_the_machine_is_suspended():
    """As Linux tells it in a namespace whose clock of it is 1,000 s ahead."""
    script = "from pixel2catch.ros2.transport import RealClock; print(RealClock(0.5).now())"
    ahead = ["unshare", "--time", "--boottime", "1000", sys.executable, "-c", script]
    before = RealClock(0.5).now()
    found = subprocess.run(ahead, capture_output=True, text=True)
    if found.returncode:
        pytest.skip(f"no namespaces of time here: {found.stderr}")
    assert 500.0 <= float(found.stdout) - before < 500.0 + PATIENCE
