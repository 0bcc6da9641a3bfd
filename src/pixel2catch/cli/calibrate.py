"""`pixel2catch calibrate`: where the camera stands, how well that is known, what it means for a policy."""

import io
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from math import degrees, hypot
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional

from pixel2catch.checks import InputFile, NewFolder, OutputFile, Positive, Within
from pixel2catch.cli.console import results_console, say, saying_changes
from pixel2catch.cli.link import Network
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import json_text, write_atomically
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest
from pixel2catch.scene.constants import RGB_CAMERA

if TYPE_CHECKING:
    from pixel2catch.camera.image import Image
    from pixel2catch.perception.calibration.capture import Capture
    from pixel2catch.perception.calibration.comparison import Comparison
    from pixel2catch.perception.calibration.extrinsics import Calibration, HandView, Pose
    from pixel2catch.perception.calibration.intrinsics import Intrinsics
    from pixel2catch.robots.workcell import WorkcellSpec

IMAGE_COLUMN = "image"  #: Column with the names of the images, relative to the folder of the table.
STEP = 1e-4  #: Angle by which joints are turned to see how the palm moves [rad].
NUM_THROWS = 200  #: Throws whose paths are compared.

LARGEST_RMS = 1.5
"""Errors above this have a cause that can be found [px]. Source: ours; corners of sharp images are found
within a few tenths of a pixel, and errors of 1 mrad in each of the arm's joints make another 0.3 px."""


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Find the camera's pose from images of a printed board in the hand, and compare it with the policies'.

    First print the board (--print-marker) and fix it to the hand, rigidly; where does not matter. Then move
    the arm to 15 poses or more: with --live images and positions of the joints are taken as you go, and you
    are told what to show next; or take an image at each, and write down its name and the joints' positions.
    """

    #: Table (CSV) with a column image and one for each joint of the arm, as wrist_1_joint [rad].
    views: Positional[Annotated[Path, InputFile()] | None] = None
    #: The robots: a name, as for `train`, or a Python file that defines WORKCELLS; the board is in the first
    #: hand.
    workcell: str = "ur5e_allegro"
    #: The lens: a .yaml of ROS's camera_calibration, a rosbag2 with a CameraInfo, a camera.json of before, or
    #: a folder with 10 or more images of the printed board.
    intrinsics: Path | None = None
    out: Annotated[Path, OutputFile(is_new=True)] = Path(
        "camera.json"
    )  #: Where to write the camera; nothing is overwritten.
    #: Take the images first, from the camera of --profile or from --source, and then calibrate; Ctrl-C ends
    #: the taking.
    live: bool = False
    #: With --live: a rosbag2 with images and joint states, or a video or camera (number, /dev/videoN), which
    #: give a lens only.
    source: str | None = None
    image_topic: str | None = None  #: With --source: topic of the images in a rosbag. Default: the only one.
    num_views: Annotated[int, Within(6, 200)] = 15  #: With --live: images that are wanted.
    capture: NewFolder = Path("views")  #: With --live: new folder for images, views.csv and coverage.svg.
    link: Network = field(default_factory=Network)  #: With --live: how the robot is reached.
    print_marker: Annotated[Path, OutputFile((".png", ".pdf"), is_new=True)] | None = (
        None  #: Only write the board to print, a .png or .pdf of A4.
    )
    square: Positive = 0.06  #: Edge of a square of the board, measured on paper [m].
    #: Columns and rows of inner corners, if the images of --intrinsics show a chessboard.
    chessboard: tuple[int, int] | None = None
    rectified: bool = False  #: The images are rectified (image_rect): the projection matrix is the lens.
    topic: str | None = None  #: Topic of the CameraInfo in a rosbag. Default: the only one.
    #: Pose of the board in the hand frame at the palm's centre, if it is known: x y z [m] and quaternion w x
    #: y z. Default: found from the images, too.
    board_pose: tuple[float, float, float, float, float, float, float] | None = None
    json: bool = False  #: Print the result as one JSON object.

    def run(self) -> None:
        """Print the board, or find the camera and write it."""
        with needs_extra("perception"):
            import pixel2catch.perception.calibration.extrinsics  # noqa: F401
        if self.print_marker is not None:
            _print_board(self.print_marker)
            return
        if self.live and (taken := self._take()):
            taken._calibrate()
        elif not self.live:
            self._calibrate()

    def _take(self) -> "Calibrate | None":
        """Take the images; return what is to be done with them, or None if there is no pose in them.

        Without --intrinsics, the lens is found from the same images.
        """
        from pixel2catch.perception.calibration.capture import PICTURE, TABLE, Capture
        from pixel2catch.perception.calibration.target import CharucoBoard
        from pixel2catch.workcells import find_workcell

        lens = self._lens(self.intrinsics) if self.intrinsics else None
        workcell = find_workcell(self.workcell)
        joints = workcell.joint_names[workcell.palms[0].carriers]
        matrix = np.array(RGB_CAMERA.matrix) if lens is None else lens.matrix
        notes: list[str] = []
        with self._frames(joints, notes) as (frames, has_joints):
            capture = Capture(
                self.capture, CharucoBoard(self.square), matrix, joints if has_joints else (), self.num_views
            )
            self._look_at(capture, frames, workcell)
        capture.draw()
        for note in notes:
            say(note)
        say(f"wrote {self.capture}: {len(capture.taken)} images, {TABLE}, and what they cover, {PICTURE}")
        lens_folder = self.intrinsics or self.capture
        if not has_joints:
            found = self._lens(lens_folder)
            say(f"a lens of {found.rms:.2f} px RMS, without a robot: give --intrinsics {self.capture}")
            return None
        return replace(self, views=self.capture / TABLE, intrinsics=lens_folder)

    @contextmanager
    def _frames(
        self, joints: tuple[str, ...], notes: list[str]
    ) -> "Iterator[tuple[Iterator[Image | None], bool]]":
        """The images of the source, and whether they come with positions of joints."""
        from pixel2catch.perception.calibration.capture import topic_frames
        from pixel2catch.perception.sources import SourceCfg, ticks_of
        from pixel2catch.ros2.bags import is_bag

        profile = self.link.robot.load()
        if self.source is None:
            with needs_extra("deployment"), self.link.join("pixel2catch_calibrate") as (transport, _):
                yield topic_frames(transport, profile, joints), True
            return
        theirs = {ours: each.name_in_state for part in profile.robots for ours, each in part.joints.items()}
        names = tuple(theirs.get(joint, joint) for joint in joints)
        source = SourceCfg(name=self.source, topic=self.image_topic, joints=names)
        with closing(ticks_of(source, notes)) as ticks:
            frames = (tick.image for tick in ticks)
            new = (next(same) for _, same in groupby(frames, key=attrgetter("stamp")))
            yield new, is_bag(Path(self.source))

    def _look_at(
        self, capture: "Capture", frames: "Iterator[Image | None]", workcell: "WorkcellSpec"
    ) -> None:
        """Look at images until all that is wanted is there, or Ctrl-C; say what changes."""
        import torch
        from scipy.spatial.transform import Rotation

        from pixel2catch.robots.geometry import first_chain

        chain, hear = first_chain(workcell), saying_changes()
        with StopRequest() as stop:
            for frame in frames:
                if stop.is_set:
                    break
                palm, words = None, "no image: does the camera's driver run, on this network?"
                if frame is not None:
                    if frame.joint_pos is not None:
                        links = chain.link_poses(torch.from_numpy(frame.joint_pos)[None])
                        palm = Rotation.from_matrix(links[0, -1, :3, :3].numpy())
                    words = capture.look(frame, palm)
                hear(words)
                if capture.is_done:
                    break

    def _calibrate(self) -> None:
        from pixel2catch.mdp.throws import ThrowCfg, sample_paths
        from pixel2catch.perception.calibration.comparison import compare
        from pixel2catch.perception.calibration.extrinsics import calibrate

        if self.intrinsics is None or self.views is None:
            raise InvalidValueError(
                "give a table of images and joint positions, and --intrinsics; or --live to take the images; "
                "or --print-marker FILE.png to begin with."
            )
        intrinsics = self._lens(self.intrinsics)
        result = calibrate(self._hand_views(self.views, intrinsics), intrinsics, self._board())
        paths = sample_paths(ThrowCfg(), NUM_THROWS).reshape(-1, 3).numpy()
        comparison = compare(result.file, RGB_CAMERA, paths)
        result.file.save(self.out)
        _print_result(result, intrinsics, comparison, as_json=self.json)
        say(f"wrote {self.out}")

    def _board(self) -> "Pose | None":
        """The pose of the board in the hand, if it is known; InvalidValueError if its orientation is none."""
        from pixel2catch.robots.poses import pose_matrix

        if self.board_pose is None:
            return None
        pos, quat = self.board_pose[:3], self.board_pose[3:]
        if abs(hypot(*quat) - 1.0) > 1e-3:
            raise InvalidValueError(f"{quat} is no unit quaternion (w, x, y, z); divide it by its norm.")
        return pose_matrix(pos, quat)

    def _lens(self, path: Path) -> "Intrinsics":
        """The lens; InvalidValueError if it is of images of another size than the policies'."""
        from pixel2catch.perception.calibration.intrinsics import read_intrinsics
        from pixel2catch.perception.calibration.target import CharucoBoard, Chessboard

        board = Chessboard(self.chessboard) if self.chessboard else CharucoBoard(self.square)
        lens = read_intrinsics(path, board, self.topic, is_rectified=self.rectified)
        wanted = (RGB_CAMERA.width, RGB_CAMERA.height)
        if lens.size != wanted:
            raise InvalidValueError(
                f"{path} is of images of {lens.size} pixels, but policies look at {wanted}: set the camera "
                "to that resolution and record again."
            )
        return lens

    def _hand_views(self, path: Path, intrinsics: "Intrinsics") -> "list[HandView]":
        """The corners in every image of a table that shows the board.

        It is a RecordingError if the table lacks a column, or has positions that no arm can have.
        """
        import torch

        from pixel2catch.arrays import read_table
        from pixel2catch.identification.recording import require_motion
        from pixel2catch.perception.calibration.extrinsics import HandView
        from pixel2catch.perception.calibration.target import CharucoBoard, read_image
        from pixel2catch.perception.segmenter import check_image
        from pixel2catch.robots.geometry import first_chain
        from pixel2catch.workcells import find_workcell

        table = read_table(path)
        workcell = find_workcell(self.workcell)
        joints = workcell.joint_names[workcell.palms[0].carriers]
        joint_pos = table.columns(joints)
        require_motion(str(path), joints, np.arange(float(len(joint_pos))), joint_pos)
        names = table.texts(IMAGE_COLUMN)
        board, views, blank = CharucoBoard(self.square), [], []
        chain = first_chain(workcell)

        def palms(positions: np.ndarray) -> np.ndarray:
            return chain.link_poses(torch.from_numpy(positions))[:, -1].numpy()

        steps = STEP * np.eye(len(joints))
        rates = [(palms(joint_pos + step) - palms(joint_pos - step)) / (2.0 * STEP) for step in steps]
        poses = zip(names, palms(joint_pos), np.stack(rates, axis=1), strict=True)
        for name, palm, palm_rates in poses:
            image = read_image(path.parent / name)
            check_image(image, *intrinsics.size)
            if view := board.find(image):
                views.append(HandView(name=name, view=view, palm=palm, palm_rates=palm_rates))
            else:
                blank.append(name)
        if blank:
            say(f"no board found in {len(blank)} of {len(names)} images: {', '.join(blank)}")
        return views


def _print_board(path: Path) -> None:
    from pixel2catch.perception.calibration.target import sheet

    page = io.BytesIO()
    sheet().savefig(page, format=path.suffix.lower().lstrip("."))
    write_atomically({path: page.getvalue()})
    say(f"wrote {path}: print it at 100 %, then measure a square for --square")


def _print_result(
    result: "Calibration", intrinsics: "Intrinsics", comparison: "Comparison", *, as_json: bool
) -> None:
    """Print the errors of the images, the camera, and what to do."""
    if as_json:
        content: dict[str, Any] = {
            "rms": result.rms,
            "lens_rms": intrinsics.rms,
            "square_ratio": result.square_ratio,
            "camera": asdict(result.file),
        }
        content |= {"views": [asdict(view) for view in result.views], "comparison": asdict(comparison)}
        print(json_text(content | {"board": result.board}), end="")
        return
    table = Table("image", "RMS [px]", "used", title="seen and computed corners")
    for view in sorted(result.views, key=lambda view: -view.rms):
        table.add_row(Text(view.name), f"{view.rms:.2f}", "yes" if view.is_used else "left out")
    console = results_console()
    console.print(table)
    for line in _sentences(result, intrinsics, comparison):
        console.print(Text(line))


def _sentences(result: "Calibration", intrinsics: "Intrinsics", comparison: "Comparison") -> Iterator[str]:
    from pixel2catch.perception.calibration.comparison import advice

    x, y, z = result.file.camera.pos
    dx, dy, dz = (100 * std for std in result.file.pos_std)
    turns = " ".join(f"±{degrees(std):.2f}°" for std in result.file.turn_std)
    used = [view for view in result.views if view.is_used]
    yield f"Camera at x {x:.3f} m ±{dx:.2f} cm, y {y:.3f} m ±{dy:.2f} cm, z {z:.3f} m ±{dz:.2f} cm"
    yield f"and turned with {turns} about x, y, z (one standard deviation)."
    worst = max(used, key=lambda view: view.rms)
    yield f"Reprojection error: {result.rms:.2f} px RMS, worst image {worst.name} with {worst.rms:.2f} px."
    ratio, std = result.square_ratio
    yield f"By the arm's motion the squares are {ratio:.3f} ± {std:.3f} times as large as --square says."
    if intrinsics.rms is not None:
        yield f"Reprojection error of the lens: {intrinsics.rms:.2f} px RMS."
    if result.rms > LARGEST_RMS:
        yield "That is a lot: are --square and the lens right, the board rigid, the arm at rest each time?"
    yield (
        f"Thrown objects are seen {comparison.mean:.1f} px from where the policies' camera sees them, at "
        f"most {comparison.largest:.1f} px; the calibration leaves {comparison.uncertainty:.1f} px open."
    )
    yield from advice(comparison)
