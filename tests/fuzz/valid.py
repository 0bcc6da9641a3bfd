"""Valid files of every kind that is read, what reads them, and how they are changed."""

import json
import random
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch

from mutation import changed_bytes, changed_json, changed_yaml
from pixel2catch.arrays import read_table
from pixel2catch.deployment.recorder import BagRecorder
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.comparison import ComparisonFolder
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.files import json_text
from pixel2catch.identification.importers import read_rosbag
from pixel2catch.identification.recording import Recording, joints_of
from pixel2catch.learning.checkpoint import Checkpoint, Progress, save_checkpoint
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.experiment import read_run
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.methods import find_method
from pixel2catch.perception.calibration.lens import CharucoBoard, read_image, read_lens
from pixel2catch.perception.labels import Label, Labels
from pixel2catch.perception.sources import images_of
from pixel2catch.policy import Policy, contract_of
from pixel2catch.policy.onnx_policy import to_onnx
from pixel2catch.rendering.video import write_video
from pixel2catch.robots.ur5e import UR5E
from pixel2catch.robots.workcell import read_mjcf
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import PROFILES, Profile
from pixel2catch.ros2.transport import Topic
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.meshes import _read as read_mesh
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

ARM = joints_of(UR5E_ALLEGRO, "ur5e")
HOME = np.array([joint.home for joint in UR5E_ALLEGRO.joints[:6]])
PIXELS = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)


CUBE = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + "".join(
    f"f {face}\n" for face in ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
)


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of file, or of folder in which one file is changed."""

    write: Callable[[Path], Path]  #: Writes a valid one into a folder; returns the file that is changed.
    read: Callable[[Path], object]  #: Reads that file, however it was changed.
    change: Callable[[bytes, random.Random], bytes] = changed_bytes


class Learner:
    cfg = TrainCfg(device="cpu")
    contract = contract_of(find_method("catch+fit"))

    def state_dict(self) -> dict[str, object]:
        return {"a": torch.zeros(3), "updates": 3}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        torch.zeros(3).copy_(state["a"])


def untrained(workcell: str = "ur5e_allegro") -> Policy:
    torch.manual_seed(0)
    return Policy(replace(contract_of(find_method("catch+fit")), workcell=workcell), hidden=(8,))


def _policy(folder: Path) -> Path:
    untrained().save(folder)
    return folder / "policy.json"


def _read_described(file: Path) -> None:
    """Read a policy, after copying its description into its weights."""
    text, weights = file.read_bytes(), file.with_name("policy.safetensors")
    whole = weights.read_bytes()
    size = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + size])
    header["__metadata__"] = {"policy": text.decode("utf-8", "replace")}
    described = json.dumps(header).encode()
    weights.write_bytes(len(described).to_bytes(8, "little") + described + whole[8 + size :])
    load_policy(file.parent)


def _weights(folder: Path) -> Path:
    return _policy(folder).with_name("policy.safetensors")


@cache
def _exported() -> bytes:
    return to_onnx(untrained())


def _onnx(folder: Path) -> Path:
    (folder / "policy.onnx").write_bytes(_exported())
    return folder / "policy.onnx"


def _recording(folder: Path) -> Path:
    times = np.arange(0.0, 1.0, 0.05)
    q = HOME + 0.01 * np.sin(times)[:, None]
    Recording(joints=ARM, t_cmd=times, q_cmd=q, t_meas=times, q=q).save(folder / "motion.npz")
    return folder / "motion.npz"


def _bag(folder: Path) -> Path:
    with BagRecorder(folder / "bag") as bag:
        for i in range(10):
            now = 1_790_000_000 + 0.1 * i
            for name, kind, data in (
                ("/joint_states", messages.JOINT_STATE, messages.joint_state(ARM, HOME + 0.001 * i, now)),
                ("/command", messages.FLOAT_ARRAY, messages.float_array(HOME)),
                ("/image", messages.IMAGE, messages.image(PIXELS[:12, :16], now)),
                ("/info", messages.CAMERA_INFO, messages.camera_info(RGB_CAMERA, now)),
            ):
                bag.record(Topic(name=name, type=kind), data, now)
    return next((folder / "bag").glob("bag.*"))


def _read_bag(file: Path) -> None:
    """Read a bag as `identify`, `track` and `calibrate` do."""
    from pixel2catch.errors import Pixel2CatchError

    path, errors = file if file.suffix != ".yaml" else file.parent, []
    for read in (
        lambda: read_rosbag(path, ARM, None, UR5E_ALLEGRO),
        lambda: [*images_of(str(path), [])],
        lambda: read_lens(path, CharucoBoard()),
    ):
        try:
            read()
        except Pixel2CatchError as error:
            errors.append(error)
    if errors:
        raise errors[0]


def _png(folder: Path) -> Path:
    cv2.imwrite(str(folder / "image.png"), PIXELS)
    return folder / "image.png"


def _mp4(folder: Path) -> Path:
    write_video(folder / "video.mp4", [PIXELS] * 4)
    return folder / "video.mp4"


def _text(name: str, content: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_text(content)
        return folder / name

    return write


def checkpoint(folder: Path, workcell: str = "ur5e_allegro") -> Path:
    contract = untrained(workcell).contract
    save_checkpoint(folder / "checkpoint.pt", Learner(), contract, Progress(transitions=5))  # type: ignore
    return folder / "checkpoint.pt"


def _read_checkpoint(file: Path) -> None:
    Checkpoint.load(file, "cpu").restore(Learner())  # type: ignore[arg-type]


def _dynamics(folder: Path) -> Path:
    DynamicsFile().save(folder / "dynamics.json")
    return folder / "dynamics.json"


BOXES = ((1.0, 2.0, 3.0, 4.0), None)
LABELS = Labels(
    video="a.mp4",
    width=64,
    height=48,
    rate=30.0,
    images=tuple(Label(image=i, time=0.1 * i, phase="held", box=box) for i, box in enumerate(BOXES)),
)
TABLE = "\n".join(
    (f"image,{','.join(ARM)}", *(f"view_{i}.png," + ",".join(map(str, HOME)) for i in range(20)))
)
RUN = {
    "train": asdict(TrainCfg(device="cpu", num_envs=4, mini_batches=2)),
    "env": asdict(CatchEnvCfg()),
    "policy": {"method": "proposed"},
    "preset": "cpu",
}
PROFILE = (PROFILES / "ur5e_allegro_v4.yaml").read_text()
PLAN = {"plan": {"methods": ["proposed"], "seeds": 1, "configuration": {"a": 1}}, "sessions": []}

MODEL = Path(UR5E.mjcf).read_text()

KINDS = {
    "policy": Kind(write=_policy, read=_read_described, change=changed_json),
    "weights": Kind(write=_weights, read=lambda file: load_policy(file.parent)),
    "onnx": Kind(write=_onnx, read=load_policy),
    "dynamics": Kind(write=_dynamics, read=DynamicsFile.load, change=changed_json),
    "labels": Kind(
        write=_text("labels.json", json_text({"format_version": 1, **asdict(LABELS)})),
        read=Labels.load,
        change=changed_json,
    ),
    "profile": Kind(write=_text("lab.yaml", PROFILE), read=Profile.load, change=changed_yaml),
    "recording": Kind(write=_recording, read=Recording.load),
    "table": Kind(write=_text("views.csv", TABLE), read=lambda file: read_table(file, ARM)),
    "mcap": Kind(write=_bag, read=_read_bag),
    "metadata": Kind(write=lambda f: _bag(f).with_name("metadata.yaml"), read=_read_bag, change=changed_yaml),
    "png": Kind(write=_png, read=read_image),
    "mp4": Kind(write=_mp4, read=lambda f: [*images_of(str(f), [])]),
    "model": Kind(write=_text("arm.xml", MODEL), read=read_mjcf),
    "mesh": Kind(write=_text("cube.obj", CUBE), read=read_mesh),
    "checkpoint": Kind(write=checkpoint, read=_read_checkpoint),
    "run": Kind(
        write=_text("config.json", json_text(RUN)),
        read=lambda file: read_run(file.parent),
        change=changed_json,
    ),
    "study": Kind(
        write=_text("study.json", json.dumps(PLAN)),
        read=lambda file: ComparisonFolder(file.parent).plan(),
        change=changed_json,
    ),
}
"""All kinds of files that are read, by name."""
