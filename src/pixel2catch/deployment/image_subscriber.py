"""The camera's images as they arrive, each with the positions of the joints at its time."""

from collections import deque
from math import inf

import numpy as np

from pixel2catch.errors import DeploymentError
from pixel2catch.mdp.sensing import ASSUMED_AGE
from pixel2catch.perception.extractor import CameraFrame
from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import ImageReading
from pixel2catch.ros2.profile import CameraProfile
from pixel2catch.ros2.transport import Clock, Message, Transport
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.motion import Joints

DEPTH = 4  #: Images that are kept until they are looked at; only the newest is. Source: ours.
MEMORY = 0.5  #: How long joint positions are remembered [s]. Source: ours; longer than an image may be late.
LENS_TOLERANCE = 0.02  #: Relative difference of focal lengths, and of centres by the width. Source: ours.

EARLIEST, LATEST = -0.05, 0.5
"""Age at arrival of images whose stamps can be meant [s]. Source: ours; outside it is another clock's."""


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
        self._images = transport.subscription(profile.image, DEPTH)
        self._lens = transport.subscription(profile.info) if profile.info else None
        self._joints: deque[tuple[float, Joints]] = deque()
        self.received: list[Message] = []  #: What the last call of `newest` took, for a recording.
        self._other_lens = ""
        self.message = ""  #: Why the last image was no good; empty if it was.
        self.stamp = -inf  #: When the newest good image was taken [s].
        self._assumes_age, self._is_stamped, self._notices = assumes_age, False, list[str]()

    def remember(self, time: float, joint_pos: Joints) -> None:
        """Note where the joints are [rad], for images of this time [s]."""
        self._joints.append((time, joint_pos))
        while self._joints[0][0] < time - MEMORY:
            self._joints.popleft()

    def newest(self) -> CameraFrame | None:
        """The newest image, if one has arrived since the last call and is good; stamps are of `Clock.now`.

        None is, as long as the camera says that it has another lens than the one that it was calibrated with.
        """
        self._check_lens()
        self.received = self._images.take()
        if not self.received:
            return None
        try:
            reading = messages.read_image(self.received[-1].data)
            self._profile.require(reading)
            if self._other_lens:
                raise DeploymentError(self._other_lens)
        except DeploymentError as error:
            self.message = str(error)
            return None
        self.message = ""
        stamp = self.stamp = self._exposed(reading, self.received[-1].arrival)
        return CameraFrame(image=reading.pixels, stamp=stamp, joint_pos=self._joints_at(stamp))

    def take_notice(self) -> str:
        """What was found out about the camera's stamps, once; else nothing."""
        return self._notices.pop() if self._notices else ""

    def _exposed(self, reading: ImageReading, arrival: float) -> float:
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
