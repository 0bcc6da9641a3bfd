"""`pixel2catch doctor`: what works on this machine, and what to install or do where something does not."""

import importlib
import importlib.metadata
import importlib.util
import platform
import shutil
import subprocess
import sys
import warnings
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from packaging.specifiers import SpecifierSet
from rich.table import Table
from rich.text import Text

from pixel2catch.checks import AtMostFull, CameraPath
from pixel2catch.cli.console import results_console
from pixel2catch.errors import DeviceUnavailableError
from pixel2catch.files import json_text
from pixel2catch.findings import Absent, Broken, Check, check
from pixel2catch.installation import PACKAGE, install_command, needs_extra, requirements
from pixel2catch.ros2.transport import LOOPBACK, NetworkName

STYLES = {"good": "green", "BAD": "bold red", "absent": "dim"}
"""Colour of each state; the word tells without colour, too."""

EXIT_BAD = 1  #: Exit status where something that is needed does not work.
NVIDIA_DRIVER = Path("/proc/driver/nvidia/version")  #: Where Linux says which driver is loaded.

CUDA_BUILD = "'uv pip install --torch-backend=auto --reinstall-package torch torch'"
"""How a build of PyTorch is installed that fits this machine. Source: documentation of uv."""

LEAST_FREE = 1e9
"""Free space that a run may need [bytes]. Source: ours; a run folder has some megabytes, a study 200."""

CAMERA_SECONDS = 3.0  #: How long a camera is watched [s].
LEAST_RATE = 29.0  #: Images a second that the policies need; they act 30 times.
DDS_SECONDS = 5.0  #: How long two nodes may take to find each other [s].
SAM2_IMAGES = 3  #: Images that SAM 2 tracks to be timed; it warms up before, where that matters.

_WARP_PROBE = """
import mujoco_warp, warp
device = warp.get_device("cuda:0")
assert (warp.full(8, 3.0, device=device).numpy() == 3.0).all()
print(f"Warp {warp.__version__} computes on {device.name}")
"""


def optional(module: str, distribution: str, extra: str) -> str:
    """The version of a package that is needed for a part only, if it can be imported and is in range."""
    if importlib.util.find_spec(module) is None:
        raise Absent(f"not installed: {install_command(extra)}")
    imported = importlib.import_module(module)
    version = getattr(imported, "__version__", None) or importlib.metadata.version(distribution)
    wanted = requirements(extra).get(distribution, SpecifierSet())
    if not wanted.contains(version, prereleases=True):
        raise Broken(f"{version} is not in {wanted}: {install_command(extra)} --upgrade")
    return version


def python() -> str:
    """The interpreter."""
    version, wanted = platform.python_version(), importlib.metadata.metadata(PACKAGE)["Requires-Python"]
    if not SpecifierSet(wanted).contains(version, prereleases=True):
        raise Broken(f"Python {version} is not in {wanted}: make setup PYTHON=python3.12")
    return version


def packages() -> str:
    """The packages that every command needs."""
    wanted = requirements()
    wrong = []
    for name, versions in wanted.items():
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            wrong.append(f"{name} is missing")
            continue
        if not versions.contains(version, prereleases=True):
            wrong.append(f"{name} {version} is not in {versions}")
    if wrong:
        raise Broken(f"{', '.join(wrong)}: {install_command()} --upgrade")
    return f"{len(wanted)} in the ranges of {PACKAGE} {importlib.metadata.version(PACKAGE)}"


def policy_and_physics() -> str:
    """The shipped policy catches for one control step, on the CPU."""
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


def disk() -> str:
    """Space for what the commands write."""
    free = shutil.disk_usage(Path.cwd()).free
    if free < LEAST_FREE:
        raise Broken(f"only {free / 1e9:.2f} GB free in {Path.cwd()}: make room or work elsewhere")
    return f"{free / 1e9:.0f} GB free"


def rendering() -> str:
    """OpenGL without a display."""
    from pixel2catch.rendering.renderer import find_gl_backend

    try:
        return find_gl_backend()
    except DeviceUnavailableError as error:
        raise Absent(f"no videos of throws: {error}") from error


def cuda() -> str:
    """A GPU that PyTorch computes on."""
    import torch

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        is_there = torch.cuda.is_available()
    if is_there:
        torch.ones(8, device="cuda").sum().item()
        memory = torch.cuda.get_device_properties(0).total_memory / 2**30
        name, count = torch.cuda.get_device_name(0), torch.cuda.device_count()
        return f"{count} x {name}, {memory:.0f} GiB, {_driver()}, CUDA {torch.version.cuda}"
    if not NVIDIA_DRIVER.exists():
        raise Absent("no NVIDIA driver: training takes an hour on a CPU; everything else works")
    said = "; ".join(str(warning.message) for warning in caught) or "PyTorch does not say why"
    build = f"a build for CUDA {torch.version.cuda}" if torch.version.cuda else "a CPU build"
    raise Broken(
        f"{_driver()}, but PyTorch {torch.__version__}, {build}, sees no GPU ({said}): take a build for this "
        f"driver, {CUDA_BUILD}, or a newer driver"
    )


def _driver() -> str:
    words = NVIDIA_DRIVER.read_text().split("\n")[0].split() if NVIDIA_DRIVER.exists() else []
    return "driver " + next((word for word in words if word[0].isdigit() and "." in word), "unknown")


def warp() -> str:
    """MuJoCo Warp's language on the GPU."""
    import torch

    if not torch.cuda.is_available():
        raise Absent("needs a CUDA device")
    return _in_process(_WARP_PROBE, f"{install_command()} --upgrade, and a driver that this Warp supports")


def torchvision() -> str:
    """Not needed; but one that does not match PyTorch keeps SAM 2 from being imported."""
    import torch

    if importlib.util.find_spec("torchvision") is None:
        return "not installed, not needed"
    return _in_process(
        "import torchvision; print(torchvision.__version__)",
        f"it does not match PyTorch {torch.__version__} and breaks SAM 2: pip uninstall torchvision",
    )


def _in_process(code: str, remedy: str) -> str:
    """Run Python code in a process of its own and return what it printed."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise Broken(f"{said[-1]}: {remedy}")
    return done.stdout.strip().splitlines()[-1]


def dds() -> str:
    """Send a message from one node to another on this machine, as `rehearse` does."""
    if importlib.util.find_spec("cyclonedds") is None:
        raise Absent(f"not looked at without cyclonedds: {install_command('deployment')}")
    from pixel2catch.ros2 import messages
    from pixel2catch.ros2.factory import make_transport
    from pixel2catch.ros2.transport import RealClock, Topic

    topic, clock = Topic(name="/pixel2catch/doctor", type=messages.BOOLEAN), RealClock()
    with (
        make_transport("dds", "doctor", LOOPBACK, clock) as ear,
        make_transport("dds", "d", LOOPBACK, clock) as mouth,
    ):
        heard, sent = ear.subscription(topic), mouth.publisher(topic)
        begin = clock.now()
        while clock.now() < begin + DDS_SECONDS:
            sent.publish(messages.boolean(True))
            if ear.wait(0.1) and heard.take():
                return f"two nodes on this machine hear each other after {clock.now() - begin:.2f} s"
    raise Broken(
        f"two nodes on this machine do not hear each other in {DDS_SECONDS:g} s: look at the interface 'lo' "
        "and at the firewall; UDP ports from 7400 on are needed."
    )


def sam2(checkpoint: Path | None) -> str:
    """A checkpoint that loads, and how long it takes for an image."""
    if checkpoint is None:
        raise Absent("not asked for: name its folder with --checkpoint")
    import torch

    from pixel2catch.perception.sam2 import Sam2Segmenter
    from pixel2catch.scene.constants import CONTROL_DT

    device = "cuda" if torch.cuda.is_available() else "cpu"
    took = Sam2Segmenter(checkpoint, device).seconds_an_image(SAM2_IMAGES)
    use = "fast enough for a camera" if took < CONTROL_DT else "for recordings only"
    return f"loads on {device}, {1e3 * took:.1f} ms an image: {use}"


def camera(source: str | None) -> str:
    """A camera that delivers what the policies need."""
    if source is None:
        raise Absent("not asked for: name it with --camera")
    from pixel2catch.perception.sources import measure_camera, open_camera
    from pixel2catch.scene.constants import RGB_CAMERA

    report = measure_camera(open_camera(source), CAMERA_SECONDS)
    found = f"{report.width} x {report.height} at {report.rate:.1f} Hz, "
    found += f"longest pause {1e3 * report.pause:.0f} ms"
    if (report.width, report.height) != (RGB_CAMERA.width, RGB_CAMERA.height):
        raise Broken(f"{found}: it cannot deliver {RGB_CAMERA.width} x {RGB_CAMERA.height}; use another")
    if report.rate < LEAST_RATE:
        raise Broken(f"{found}: 30 Hz are needed; more light or a fixed exposure, or another USB port")
    return found


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Check this machine: versions, policy, physics, rendering, GPU, perception, network; and a laboratory.

    The exit status is 0 if `catch` and `evaluate` work, and what an option asks for.
    """

    checkpoint: Path | None = None  #: Folder of a SAM 2.1 checkpoint to load and time, too.
    camera: str | None = None  #: Number or device of a camera to watch for three seconds, too.
    #: Profile of a robot, shipped or a .yaml file, to examine with its machine, drivers and camera, too.
    #: Nothing is sent to it. See docs/laboratory.md.
    robot: str | None = None
    #: Camera file that `calibrate` wrote, to compare the robot's camera with. Default: the policies' camera.
    lens: CameraPath | None = None
    #: Network of the robot: an interface of this machine, such as eth0, or any. lo is the digital twin,
    #: beside which real time does not matter.
    network: NetworkName = LOOPBACK
    clock: AtMostFull = 1.0  #: Seconds in a real second: 1, or the --clock of that twin.
    json: bool = False  #: Print all checks as one JSON object.

    def run(self) -> None:
        """Check and print.

        Raises:
            SystemExit: With status 1 if something needed does not work.
        """
        laboratory = self._laboratory(self.robot) if self.robot else []
        checks = self._checks() + laboratory
        if self.json:
            print(json_text({"checks": [asdict(check) for check in checks]}), end="")
        else:
            self._print(checks)
        if any(check.is_needed and check.state == "BAD" for check in checks):
            sys.exit(EXIT_BAD)

    def _laboratory(self, profile: str) -> list[Check]:
        """Look at the machine of a deployment, and listen to a robot."""
        from pixel2catch.camera.camera_file import CameraFile
        from pixel2catch.cli.link import Network, Robot
        from pixel2catch.scene.constants import RGB_CAMERA

        with needs_extra("deployment"):
            from pixel2catch.deployment.laboratory import checks_of_laboratory
            from pixel2catch.deployment.survey import take_survey
        network = Network(robot=Robot(profile=profile), network=self.network, clock=self.clock)
        robot = network.robot.load()
        lens = CameraFile.load(self.lens).camera if self.lens else RGB_CAMERA
        with network.join("pixel2catch_doctor") as (transport, clock):
            survey = take_survey(transport, robot, clock)
        return checks_of_laboratory(robot, survey, lens, is_loopback=network.is_twin)

    def _checks(self) -> list[Check]:
        return [
            check("Python", python, is_needed=True),
            check("packages", packages, is_needed=True),
            check("policy, physics", policy_and_physics, is_needed=True),
            check("disk", disk, is_needed=True),
            check("rendering", rendering),
            check("GPU", cuda),
            check("Warp on the GPU", warp),
            check("OpenCV", partial(optional, "cv2", "opencv-python-headless", "perception")),
            check("rosbags", partial(optional, "rosbags", "rosbags", "identification")),
            check("cyclonedds", partial(optional, "cyclonedds", "cyclonedds", "deployment")),
            check("numba", partial(optional, "numba", "numba", "deployment")),
            check("DDS", dds),
            check("viser", partial(optional, "viser", "viser", "viewer")),
            check("ONNX Runtime", partial(optional, "onnxruntime", "onnxruntime", "onnx")),
            check("pyarrow", partial(optional, "pyarrow", "pyarrow", "lerobot")),
            check("transformers", partial(optional, "transformers", "transformers", "sam2")),
            check("torchvision", torchvision),
            check("SAM 2", partial(sam2, self.checkpoint), is_needed=self.checkpoint is not None),
            check("camera", partial(camera, self.camera), is_needed=self.camera is not None),
        ]

    def _print(self, checks: list[Check]) -> None:
        """Print a table, and what it means."""
        table = Table("check", "", "found")
        for each in checks:
            style = STYLES[each.state]
            table.add_row(each.name, Text(each.state, style=style), Text(each.found, style=style))
        console = results_console()
        console.print(table)
        bad = [check.name for check in checks if check.state == "BAD" and check.is_needed]
        fine = f"`catch` and `evaluate` work here{', and the robot is ready' if self.robot else ''}."
        console.print(f"To be mended: {', '.join(bad)}." if bad else fine)
