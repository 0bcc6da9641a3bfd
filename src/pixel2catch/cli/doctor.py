"""`pixel2catch doctor`: check this machine or a laboratory, and print what to install or to correct."""

import importlib
import importlib.metadata
import importlib.util
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from pixel2catch.checks import CameraPath, Fraction, require_used
from pixel2catch.cli.console import results_console
from pixel2catch.files import json_text, printable
from pixel2catch.installation import (
    PACKAGE,
    Absent,
    Broken,
    Check,
    check,
    install_command,
    needs_extra,
    requirements,
)
from pixel2catch.reports import terminal_table
from pixel2catch.ros2.transport import LOOPBACK, NetworkName

EXIT_BAD = 1  #: Exit status if something that is needed does not work.
NVIDIA_DRIVER = Path("/proc/driver/nvidia/version")  #: Version of the loaded driver, on Linux.

CUDA_BUILD = "'uv pip install --torch-backend=auto --reinstall-package torch torch'"
"""Command that installs a build of PyTorch for this machine. Source: documentation of uv."""

OURS = ("dev", "docs")  #: Extras for work on this package.
DDS_SECONDS = 5.0  #: Time in which two nodes must find each other [s]. Source: ours.


def packages(extra: str = "") -> str:
    """Check that the packages of an extra, or those that every command needs, have versions in range."""
    missing, wrong = list[str](), list[str]()
    for name, versions in requirements(extra).items():
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(f"{name} is missing")
            continue
        if not versions.contains(version, prereleases=True):
            wrong.append(f"{name} {version} is not in {versions}")
    if missing or wrong:
        kind = Absent if extra and missing else Broken
        raise kind(f"{', '.join(wrong + missing)}: {install_command(extra)} --upgrade")
    return ", ".join(requirements(extra))


def policy_and_physics() -> str:
    """Check that the shipped policy acts for one control step, on the CPU."""
    from pixel2catch.evaluation.loading import load_policy, task_of
    from pixel2catch.evaluation.protocol import EvaluationCfg

    policy, method = load_policy(None)
    env = EvaluationCfg(objects=("cube_s",), num_envs=1, task=task_of(policy)).make_env(method)
    try:
        begin = env.reset()
        env.step(policy.act(begin.policy))
        env.check()
    finally:
        env.close()
    return f"{method.name} loads and acts"


def gpu() -> str:
    """Check that PyTorch and Warp compute on a GPU."""
    import torch

    if torch.cuda.is_available():
        warp = importlib.import_module("warp")
        warp.full(8, 3.0, device="cuda:0").numpy()
        found = torch.cuda.get_device_properties(0)
        return (
            f"{torch.cuda.device_count()} x {found.name}, {found.total_memory / 2**30:.0f} GiB, "
            f"CUDA {torch.version.cuda}, Warp {warp.__version__}"
        )
    if not NVIDIA_DRIVER.exists():
        raise Absent("no NVIDIA driver: training takes an hour on a CPU; everything else works")
    build = f"a build for CUDA {torch.version.cuda}" if torch.version.cuda else "a CPU build"
    raise Broken(
        f"{NVIDIA_DRIVER.read_text().splitlines()[0]}, but PyTorch {torch.__version__}, {build}, finds no "
        f"GPU: install a build for this driver, {CUDA_BUILD}, or a newer driver"
    )


def dds() -> str:
    """Check that two nodes on this machine receive each other's messages."""
    from pixel2catch.ros2 import messages
    from pixel2catch.ros2.transport import RealClock, Topic, make_transport

    topic, clock = Topic(name="/pixel2catch/doctor", type=messages.BOOLEAN), RealClock()
    with (
        make_transport("receiver", LOOPBACK, clock) as receiver,
        make_transport("sender", LOOPBACK, clock) as sender,
    ):
        subscription, publisher = receiver.subscription(topic), sender.publisher(topic)
        begin = clock.now()
        while clock.now() < begin + DDS_SECONDS:
            publisher.publish(messages.boolean(True))
            if receiver.wait(0.1) and subscription.take():
                return f"two nodes on this machine connect after {clock.now() - begin:.2f} s"
    raise Broken(
        f"two nodes on this machine do not connect in {DDS_SECONDS:g} s: check the interface 'lo' and the "
        "firewall; UDP ports from 7400 on are needed."
    )


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Check this machine, or a laboratory.

    The exit status is 0 if `catch` and `evaluate` work, and with --robot the laboratory is ready.
    """

    #: Profile of a robot, shipped or a .yaml file, whose machine, drivers and camera are checked as well.
    #: Nothing is sent to it. See docs/laboratory.md.
    robot: str | None = None
    #: Camera file of `calibrate` to compare the robot's camera with. Default: the policies' camera.
    lens: CameraPath | None = None
    #: Network of the robot: an interface of this machine, such as eth0, or any. lo is the digital twin, for
    #: which real-time settings are not needed.
    network: NetworkName = LOOPBACK
    clock: Fraction = 1.0  #: Clock seconds in a real second: 1, or the --clock of a digital twin.
    json: bool = False  #: Print all checks as one JSON object.

    def run(self) -> None:
        require_used(self, ("lens", "network", "clock"), bool(self.robot), "without --robot")
        checks = self._checks() + (self._laboratory(self.robot) if self.robot else [])
        bad = [each.name for each in checks if each.state == "BAD" and each.is_needed]
        if self.json:
            print(json_text({"checks": [asdict(check) for check in checks]}), end="")
        else:
            rows = [{"check": c.name, "state": c.state, "found": printable(c.found)} for c in checks]
            fine = f"`catch` and `evaluate` work here{', and the robot is ready' if self.robot else ''}."
            console = results_console()
            console.print(terminal_table("checks", rows))
            console.print(f"To correct: {', '.join(bad)}." if bad else fine)
        if bad:
            raise SystemExit(EXIT_BAD)

    def _laboratory(self, profile: str) -> list[Check]:
        from pixel2catch.camera.camera_file import CameraFile
        from pixel2catch.cli.link import Network, Robot
        from pixel2catch.scene.constants import RGB_CAMERA

        with needs_extra("deployment"):
            from pixel2catch.deployment.laboratory import Survey, checks_of_laboratory
        network = Network(robot=Robot(profile=profile), network=self.network, clock=self.clock)
        robot = network.robot.load()
        lens = CameraFile.load(self.lens).camera if self.lens else RGB_CAMERA
        with network.join("pixel2catch_doctor", network.in_words(robot)) as (transport, clock):
            survey = Survey(transport, robot, clock)
            survey.take()
        return checks_of_laboratory(robot, survey, lens, is_loopback=network.is_twin)

    def _checks(self) -> list[Check]:
        from pixel2catch.rendering.renderer import find_gl_backend

        extras = importlib.metadata.metadata(PACKAGE).get_all("Provides-Extra") or []
        return [
            check("packages", packages, is_needed=True),
            check("policy, physics", policy_and_physics, is_needed=True),
            check("OpenGL, for films", find_gl_backend),
            check("GPU", gpu),
            *(check(f"extra {name}", partial(packages, name)) for name in extras if name not in OURS),
            *([check("DDS", dds)] if importlib.util.find_spec("cyclonedds") else []),
        ]
