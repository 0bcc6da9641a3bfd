"""`pixel2catch calibrate`: the camera's pose, its uncertainty, and what it means for a policy."""

import io
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from rich.text import Text
from tyro.conf import Positional

from pixel2catch.checks import InputFile, NewFolder, OutputFile, Positive, require_only, require_used
from pixel2catch.cli.console import results_console, say, saying_changes, suggest
from pixel2catch.cli.link import Network
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import free_folder, write_atomically
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest
from pixel2catch.reports import terminal_table
from pixel2catch.scene.constants import RGB_CAMERA, Vec3

if TYPE_CHECKING:
    from pixel2catch.camera.camera_file import CameraFile
    from pixel2catch.perception.calibration.comparison import Comparison
    from pixel2catch.perception.calibration.extrinsics import Calibration, HandView
    from pixel2catch.ros2.profile import Profile
    from pixel2catch.ros2.transport import Clock, Transport

IMAGE_COLUMN = "image"  #: Column with the names of the images, relative to the folder of the table.
NUM_THROWS = 200  #: Throws at whose points the calibrated camera is compared with the policy's.


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Find the camera's pose from images of a board in the hand.

    First print the board (--print-marker) and fix it rigidly to the hand, anywhere. Then move the arm to 15
    poses: near and far, in all parts of the image, tilted in all directions, with the hand turned about two
    axes. With --live, images and joint positions are taken at each pose. Without it, take an image at each
    pose, and write a table of their names and the joint positions.
    """

    #: Table (CSV) with a column image and one for each joint of the arm, as wrist_1_joint [rad].
    views: Positional[Annotated[Path, InputFile()] | None] = None
    #: The robots: a name, as for `train`; the board is in the first hand.
    workcell: str = "ur5e_allegro"
    #: The lens: a .yaml of ROS's camera_calibration, a rosbag2 with a CameraInfo, an earlier camera.json, or
    #: a folder with 10 or more images of the printed board. Default with --live: the images that are taken.
    intrinsics: Path | None = None
    #: New file for the camera.
    out: Annotated[Path, OutputFile()] = Path("camera.json")
    live: bool = False  #: Take the images first, from the camera of --profile; Ctrl-C ends this part.
    #: With --live: new folder for images and views.csv.
    capture: NewFolder = field(default_factory=partial(free_folder, "views"))
    #: Only measure the camera's stamps: offset, and readout time of a rolling shutter. For 20 s, lead the arm
    #: by hand so that the board moves fast up and down in the image.
    timing: bool = False
    link: Network = field(default_factory=Network)  #: With --live or --timing: the network of the robot.
    #: Only write the board to print, a .png or .pdf of A4.
    print_marker: Annotated[Path, OutputFile((".png", ".pdf"), is_new=True)] | None = None
    square: Positive = 0.06  #: Edge of a square of the board, measured on paper [m].
    rectified: bool = False  #: The images are rectified (image_rect): the projection matrix is the lens.
    topic: str | None = None  #: Topic of the CameraInfo in a rosbag. Default: the only one.

    def run(self) -> None:
        with needs_extra("perception"):
            from pixel2catch.perception.calibration.lens import sheet
        if self.print_marker is not None:
            require_only(self, ("print_marker",), "with --print-marker")
            page = io.BytesIO()
            sheet().savefig(page, format=self.print_marker.suffix.lower().lstrip("."))
            write_atomically({self.print_marker: page.getvalue()})
            say(f"wrote {self.print_marker}: print it at 100 %, then measure a square for --square")
            return
        if self.timing:
            require_only(self, ("timing", "link", "workcell", "square"), "with --timing")
            self._measure_timing()
            return
        require_used(self, ("capture",), self.live, "without --live")
        require_used(self, ("views",), not self.live, "with --live")
        require_used(self.link, ("robot", "network", "clock"), self.live, "without --live or --timing")
        OutputFile(is_new=True).require("out", self.out)
        table = self.capture / "views.csv" if self.live else self.views
        if table is None or not (self.live or self.intrinsics):
            raise InvalidValueError(
                "give a table of images and joint positions, and --intrinsics; or --live to take the images; "
                "or --print-marker FILE.png to begin with."
            )
        lens = self._lens(self.intrinsics) if self.intrinsics else None
        if self.live:
            self._take()
        self._calibrate(table, lens or self._lens(self.capture))

    @contextmanager
    def _robot(self) -> "Iterator[tuple[Transport, Clock, Profile, tuple[str, ...]]]":
        """Join the network of the robot; yield it with the joints that carry the board."""
        from pixel2catch.workcells import find_workcell

        workcell, profile = find_workcell(self.workcell), self.link.robot.load()
        joints = workcell.joint_names[workcell.palms[0].carriers]
        words = self.link.in_words(profile)
        with needs_extra("deployment"), self.link.join("pixel2catch_calibrate", words) as (transport, clock):
            yield transport, clock, profile, joints

    def _take(self) -> None:
        """Take images of the board and write views.csv until there are enough images, or until Ctrl-C."""
        from pixel2catch.perception.calibration.capture import NUM_VIEWS, Capture, topic_images
        from pixel2catch.perception.calibration.lens import CharucoBoard

        hear = saying_changes()
        with self._robot() as (transport, _, profile, joints), StopRequest() as stop:
            capture = Capture(self.capture, CharucoBoard(self.square), joints)
            for image in topic_images(transport, profile, joints, deque(maxlen=1)):
                missing = "no image: does the camera's driver run, on this network?"
                hear(missing if image is None else capture.look(image))
                if len(capture.taken) >= NUM_VIEWS or stop.is_set:
                    break
        say(f"wrote {self.capture}: {len(capture.taken)} images and views.csv")

    def _measure_timing(self) -> None:
        """Print the camera's times as they are written in a profile."""
        from pixel2catch.perception.calibration.lens import CharucoBoard
        from pixel2catch.perception.calibration.timing import SECONDS, watch

        with self._robot() as (transport, clock, profile, joints):
            say(f"move the board fast, up and down in the image, for {SECONDS:.0f} s")
            motion = watch(transport, clock, profile, joints, CharucoBoard(self.square))
        timing = motion.timing(profile.camera.height)
        say(f"from {len(motion.views)} images; write these lines into the camera of your profile:")
        print(f"  stamp_offset: {timing.stamp_offset:.4f} # +- {timing.offset_std:.4f} s")
        print(f"  readout_time: {timing.readout_time:.4f} # +- {timing.readout_std:.4f} s")

    def _calibrate(self, table: Path, lens: "CameraFile") -> None:
        from pixel2catch.mdp.throws import ThrowCfg, sample_paths
        from pixel2catch.perception.calibration.comparison import compare
        from pixel2catch.perception.calibration.extrinsics import calibrate
        from pixel2catch.workcells import find_workcell

        result = calibrate(self._hand_views(table, lens), lens)
        paths = sample_paths(ThrowCfg(), NUM_THROWS).reshape(-1, 3).numpy()
        comparison = compare(result.file, RGB_CAMERA, paths)
        result.file.save(self.out)
        rows = [
            {"image": name, "RMS [px]": f"{rms:.2f}", "used": "no" if name in result.left_out else "yes"}
            for name, rms in sorted(result.errors.items(), key=lambda each: -each[1])
        ]
        console = results_console()
        console.print(terminal_table("seen and computed corners", rows))
        for line in _sentences(result, comparison, find_workcell(self.workcell).robots[0].pos):
            console.print(Text(line))
        say(f"wrote {self.out}")
        suggest("evaluate", "--camera", self.out)

    def _lens(self, path: Path) -> "CameraFile":
        """The lens; InvalidValueError if its images have another size than the policies'."""
        from pixel2catch.perception.calibration.lens import CharucoBoard, read_lens

        lens = read_lens(path, CharucoBoard(self.square), self.topic, is_rectified=self.rectified)
        size = (lens.camera.width, lens.camera.height)
        wanted = (RGB_CAMERA.width, RGB_CAMERA.height)
        if size != wanted:
            fix = f"policies look at {wanted}: set the camera to it and record again"
            raise InvalidValueError(f"{path} is of images of {size} pixels, but {fix}.")
        return lens

    def _hand_views(self, path: Path, lens: "CameraFile") -> "list[HandView]":
        """Return the corners in every image of a table that shows the board."""
        import torch

        from pixel2catch.arrays import read_table
        from pixel2catch.identification.recording import require_motion
        from pixel2catch.perception.calibration.extrinsics import HandView
        from pixel2catch.perception.calibration.lens import CharucoBoard, read_image
        from pixel2catch.perception.segmenter import check_image
        from pixel2catch.robots.geometry import chain_of, pose_and_slopes
        from pixel2catch.workcells import find_workcell

        workcell = find_workcell(self.workcell)
        joints = workcell.joint_names[workcell.palms[0].carriers]
        joint_pos, names = read_table(path, joints, text=IMAGE_COLUMN)
        require_motion(str(path), joints, np.arange(float(len(joint_pos))), joint_pos, workcell)
        board, views, blank = CharucoBoard(self.square), [], []
        chain = chain_of(workcell, workcell.palms[0])
        poses, slopes = (each.numpy() for each in pose_and_slopes(chain, torch.from_numpy(joint_pos)))
        for name, palm, rates in zip(names, poses, slopes, strict=True):
            image = read_image(path.parent / name)
            check_image(image, lens.camera.width, lens.camera.height)
            if view := board.find(image):
                views.append(HandView(name=name, view=view, palm=palm, palm_rates=rates))
            else:
                blank.append(name)
        if blank:
            say(f"no board found in {len(blank)} of {len(names)} images: {', '.join(blank)}")
        return views


def _sentences(result: "Calibration", comparison: "Comparison", base: Vec3) -> Iterator[str]:
    from pixel2catch.perception.calibration.comparison import advice

    ways = (("behind", "in front of"), ("to the right of", "to the left of"), ("below", "above"))
    place = ", ".join(
        f"{abs(value):.3f} m ±{100 * std:.2f} cm {words[int(value > 0.0)]}"
        for value, std, words in zip(
            np.subtract(result.file.camera.pos, base), result.pose_std[:3], ways, strict=True
        )
    )
    turns = " ".join(f"±{degrees(std):.2f}°" for std in result.pose_std[3:])
    yield f"The camera is {place} the robot's base, with the thrower in front,"
    yield f"and turned with {turns} about x, y, z (one standard deviation)."
    yield "Compare that with a tape measure: images show no constant error of the arm's first joint."
    worst = max(result.errors.keys() - result.left_out, key=lambda name: result.errors[name])
    error = f"worst image {worst} with {result.errors[worst]:.2f} px"
    yield f"Reprojection error: {result.rms:.2f} px RMS, {error}."
    ratio, std = result.square_ratio
    yield f"By the arm's motion the squares are {ratio:.3f} ± {std:.3f} times as large as --square says."
    ratio, std = result.focal_ratio
    yield f"The focal length is {ratio:.4f} ± {std:.4f} times the lens's; the file has the result."
    yield (
        f"Thrown objects are seen {comparison.mean:.1f} px from where the policies' camera sees them, at "
        f"most {comparison.largest:.1f} px; the calibration is uncertain by {comparison.uncertainty:.1f} px."
    )
    yield from advice(comparison)
