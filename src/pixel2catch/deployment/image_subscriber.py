"""The camera's images as they arrive, each with the positions of the joints at its time."""

from collections import deque
from math import inf

import numpy as np

from pixel2catch.camera.image import Image
from pixel2catch.errors import DeploymentError
from pixel2catch.mdp.sensing import ASSUMED_AGE
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import CameraProfile
from pixel2catch.ros2.transport import POLL_TIME, Clock, Message, Transport
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import Joints

DEPTH = 4  #: Images that are kept until they are looked at; only the newest is. Source: ours.
MEMORY = 0.5  #: How long joint positions are remembered [s]. Source: ours; longer than an image may be late.
LENS_TOLERANCE = 0.02  #: Relative difference of focal lengths, and of centres by the width. Source: ours.

EARLIEST, LATEST = -0.05, 0.5
"""Age at arrival of images whose stamps can be meant [s]. Source: ours; outside it is another clock's."""

NUM_EQUAL = 4
"""Equal images in a row that no camera takes, as its sensor has noise. Source: ours; a recording, or a camera
that is asked for more images than it takes, may repeat one."""

THINNING = 8  #: Rows and columns of which one is compared before all are [px]. Source: ours.
DISTRUST_TIME = 1.0
"""Time for which images are not trusted after one that is older than its predecessor [s]. Source: ours."""


class ImageChecks:
    """Finds out whether the images can be those of one camera that looks."""

    def __init__(self, transport: Transport, profile: CameraProfile, clock: Clock) -> None:
        """Trust the camera."""
        self._transport, self._profile, self._clock = transport, profile, clock
        self._before: Image | None = None
        self._num_equal, self._next_poll, self._distrusted_until = 1, -inf, -inf
        self._others = self._size = self._older = ""

    @property
    def problem(self) -> str:
        """Why the images cannot be trusted; empty if they can."""
        if self._num_equal >= NUM_EQUAL:
            name = self._profile.image.name
            return (
                f"the image on {name} is frozen: new ones have the same pixels. Restart the camera's driver."
            )
        is_distrusted = self._clock.now() < self._distrusted_until
        return self._others or self._size or (self._older if is_distrusted else "")

    def count_cameras(self) -> None:
        """Look from time to time how many cameras there are."""
        if (now := self._clock.now()) < self._next_poll:
            return
        self._next_poll = now + POLL_TIME
        topics = [topic for topic in (self._profile.image, self._profile.info) if topic]
        shared = [topic.name for topic in topics if self._transport.num_other_publishers(topic) > 1]
        self._others = f"several publish {' and '.join(shared)}: end all but one." if shared else ""

    def is_new(self, reading: Image) -> bool:
        """Take note of the next image; say whether it is none that was there before."""
        before, self._before = self._before, reading
        self._size = ""
        try:
            self._profile.require(reading)
        except DeploymentError as error:
            self._size = str(error)
        if before is None or self._size:
            self._num_equal = 1
            return not self._size
        if 0.0 < reading.stamp < before.stamp:
            self._distrusted_until = self._clock.now() + DISTRUST_TIME
            self._older = (
                f"an image on {self._profile.image.name} is {before.stamp - reading.stamp:.2g} s older than "
                "the one before: two cameras, a recording that begins anew, or a clock that was set."
            )
        is_repeated = reading.stamp == before.stamp != 0.0
        is_equal = are_equal(before.pixels, reading.pixels)
        self._num_equal = self._num_equal + (not is_repeated) if is_equal else 1
        return not is_equal


def are_equal(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two images have the same pixels: mostly some of them say that they have not."""
    few = slice(None, None, THINNING)
    return np.array_equal(one[few, few], other[few, few]) and np.array_equal(one, other)


class ImageSubscriber:
    """Takes images from the network."""

    def __init__(
        self,
        transport: Transport,
        profile: CameraProfile,
        camera: CameraSpec,
        clock: Clock,
        *,
        assumes_age: bool = False,
    ) -> None:
        """Begin to listen.

        The camera is what policy and laboratory agree on; images have stamps of the clock. Those of a camera
        without sound stamps are taken to be `ASSUMED_AGE` control steps old when they arrive, if that is to
        be assumed; else they are as old as they say, and the servo refuses them.
        """
        self._profile, self._camera, self._clock = profile, camera, clock
        self._checks = ImageChecks(transport, profile, clock)
        self._images = transport.subscription(profile.image, DEPTH)
        self._lens = transport.subscription(profile.info) if profile.info else None
        self._joints: deque[tuple[float, Joints]] = deque()
        self.received: list[Message] = []  #: What the last call of `newest` took, for a recording.
        self._other_lens = self._ahead = ""
        self.message = ""  #: Why the last image could not be read; empty if it could.
        self.stamp = -inf  #: When the newest good image was taken [s].
        self._assumes_age, self._is_stamped, self._notices = assumes_age, False, list[str]()

    def remember(self, time: float, joint_pos: Joints) -> None:
        """Note where the joints are [rad], for images of this time [s]."""
        self._joints.append((time, joint_pos))
        while self._joints[0][0] < time - MEMORY:
            self._joints.popleft()

    @property
    def problem(self) -> str:
        """Why no image is good, be it readable; empty if that is not so.

        The camera may have another lens than the one that it was calibrated with, or not be one that looks.
        Its clock may have been set.
        """
        return self._checks.problem or self._other_lens or self._ahead

    def newest(self) -> Image | None:
        """The newest image, if one has arrived since the last call and is good; stamps are of `Clock.now`."""
        self._check_lens()
        self._checks.count_cameras()
        self.received = self._images.take()
        newest: Image | None = None
        for message in self.received:
            try:
                reading = messages.read_image(message.data)
            except DeploymentError as error:
                self.message = str(error)
                continue
            self.message = self._ahead = ""
            is_new = self._checks.is_new(reading)
            if not self.problem:
                stamp = self._exposed(reading, message.arrival)
                if (ahead := stamp - self._clock.now()) > -EARLIEST:
                    name = self._profile.image.name
                    self._ahead = f"images on {name} are of {ahead:.2g} s ahead: synchronise the clocks."
                    continue
                self.stamp = stamp
                if is_new:
                    newest = Image(pixels=reading.pixels, stamp=stamp, joint_pos=self._joints_at(stamp))
        return None if self.problem else newest

    def take_notice(self) -> str:
        """What was found out about the camera's stamps, once; else nothing."""
        return self._notices.pop() if self._notices else ""

    def _exposed(self, reading: Image, arrival: float) -> float:
        """When an image was taken [s], from its stamp or, if there is no sound one, from its arrival [s].

        Once stamps were sound, they are believed: what is old then is late.
        """
        stamp = self._clock.now() - (self._clock.stamp() - reading.stamp)
        has_one, was_stamped = reading.stamp != 0.0, self._is_stamped
        is_sound = has_one and EARLIEST <= arrival - stamp <= LATEST
        self._is_stamped = is_sound or (was_stamped and has_one)
        if self._is_stamped or not self._assumes_age:
            return stamp
        if was_stamped or self.stamp == -inf:
            self._notices = [_no_stamps(self._profile.image.name, has_one, arrival - stamp)]
        return arrival - ASSUMED_AGE * CONTROL_DT

    def _joints_at(self, time: float) -> Joints | None:
        """The positions nearest to a time [s], if they are known."""
        if not self._joints:
            return None
        _, joint_pos = min(self._joints, key=lambda known: abs(known[0] - time))
        return None if np.isnan(joint_pos).any() else joint_pos

    def _check_lens(self) -> None:
        """Compare what the camera says of its lens with the calibration."""
        for message in self._lens.take() if self._lens else ():
            try:
                lens = messages.read_camera_info(message.data).camera
                self._other_lens = other_lens(lens, self._camera)
            except DeploymentError as error:
                self._other_lens = str(error)


def other_lens(found: CameraSpec, known: CameraSpec) -> str:
    """What is to be done where a camera's lens is not the one that is known; nothing where it is."""
    theirs, ours = ((each.fx, each.fy, each.cx, each.cy) for each in (found, known))
    scale = np.array((known.fx, known.fy, known.width, known.width))
    if (np.abs(np.subtract(theirs, ours)) <= LENS_TOLERANCE * scale).all():
        return ""
    says, has = (", ".join(f"{number:.1f}" for number in each) for each in (theirs, ours))
    return (
        f"the camera says fx, fy, cx, cy are {says}, the policy's are {has}: calibrate the camera, and train "
        "with 'train --camera'."
    )


def _no_stamps(topic: str, has_one: bool, age: float) -> str:
    """What is said of images without sound stamps, which seem to be so old when they arrive [s]."""
    seem = (
        f"have stamps of {abs(age):.2g} s {'ago' if age > 0.0 else 'ahead'}" if has_one else "have no stamps"
    )
    assumed = 1e3 * ASSUMED_AGE * CONTROL_DT
    return (
        f"images on {topic} {seem}: each is taken to be {assumed:.0f} ms old when it arrives. Have the "
        "driver write the time of exposure into header.stamp, and synchronise the clocks of the two machines."
    )
