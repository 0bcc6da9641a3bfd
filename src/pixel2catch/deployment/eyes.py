"""The camera's images as they arrive, each with the positions of the joints at its time."""

from collections import deque

import numpy as np

from pixel2catch.deployment import messages
from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.motion import Joints
from pixel2catch.deployment.profile import CameraProfile
from pixel2catch.deployment.transport import Packet, Transport
from pixel2catch.errors import DeploymentError
from pixel2catch.perception.finder import CameraFrame
from pixel2catch.robot.constants import CameraSpec

DEPTH = 4
"""Images that are kept until they are looked at; only the newest is. Source: ours."""

MEMORY = 0.5
"""How long joint positions are remembered [s]. Source: ours; longer than an image may be late."""

LENS_TOLERANCE = 0.02
"""Relative difference of focal lengths, and of the centre by the width, that is none. Source: ours."""


class Eyes:
    """Takes images from the network.

    Attributes:
        packets: The messages of the last call of `newest`, for a recording.
        num_lost: Images that came while another was looked at.
        message: Why the last image was no good; empty if it was.
    """

    def __init__(
        self, transport: Transport, profile: CameraProfile, camera: CameraSpec, clock: Clock
    ) -> None:
        """Begin to listen.

        Args:
            transport: The node of the network.
            profile: The camera's driver.
            camera: What the policy and the laboratory agree that the camera is.
            clock: Whose `stamp` the images have.
        """
        self._profile, self._camera, self._clock = profile, camera, clock
        self._images = transport.subscription(profile.image, DEPTH)
        self._lens = transport.subscription(profile.info) if profile.info else None
        self._joints: deque[tuple[float, Joints]] = deque()
        self.packets: list[Packet] = []
        self.num_lost, self.message = 0, ""

    def remember(self, time: float, joint_pos: Joints) -> None:
        """Note where the joints are [rad], for images of this time [s]."""
        self._joints.append((time, joint_pos))
        while self._joints[0][0] < time - MEMORY:
            self._joints.popleft()

    def newest(self) -> CameraFrame | None:
        """The newest image, if one has arrived since the last call and is good; stamps are of `Clock.now`.

        Raises:
            DeploymentError: The camera has another lens than the one that it was calibrated with.
        """
        self._check_lens()
        self.packets = self._images.take()
        self.num_lost += max(len(self.packets) - 1, 0)
        if not self.packets:
            return None
        try:
            reading = messages.read_image(self.packets[-1].data)
            self._profile.require(reading)
        except DeploymentError as error:
            self.message = str(error)
            return None
        self.message = ""
        stamp = self._clock.now() - (self._clock.stamp() - reading.stamp)
        return CameraFrame(image=reading.pixels, stamp=stamp, joint_pos=self._joints_at(stamp))

    def _joints_at(self, time: float) -> Joints | None:
        """The positions nearest to a time [s], if they are known."""
        if not self._joints:
            return None
        _, joint_pos = min(self._joints, key=lambda known: abs(known[0] - time))
        return None if np.isnan(joint_pos).any() else joint_pos

    def _check_lens(self) -> None:
        """Compare what the camera says of its lens with the calibration."""
        for packet in self._lens.take() if self._lens else ():
            lens, camera = messages.read_camera_info(packet.data), self._camera
            pairs = (
                (lens.fx, camera.fx, camera.fx),
                (lens.fy, camera.fy, camera.fy),
                (lens.cx, camera.cx, camera.width),
                (lens.cy, camera.cy, camera.width),
            )
            if any(abs(found - known) > LENS_TOLERANCE * scale for found, known, scale in pairs):
                raise DeploymentError(
                    f"the camera says fx, fy, cx, cy are {lens.fx:.1f}, {lens.fy:.1f}, {lens.cx:.1f}, "
                    f"{lens.cy:.1f}, the policy's are {camera.fx:.1f}, {camera.fy:.1f}, {camera.cx:.1f}, "
                    f"{camera.cy:.1f}: calibrate the camera, and train with 'train --camera'."
                )
