"""Images from their arrival to their box: received, checked, and processed one at a time."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future, wait
from dataclasses import replace
from functools import partial
from math import inf
from typing import Any

import numpy as np

from pixel2catch.camera.image import Box, Image, Verdict
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.errors import DeploymentError
from pixel2catch.mdp.sensing import ASSUMED_AGE
from pixel2catch.perception.segmenter import BoxPrompt
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import CameraProfile
from pixel2catch.ros2.transport import POLL_TIME, Clock, Message, Transport
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.servo.limits import Joints

DEPTH = 4  #: Images kept between two polls; only the newest is processed. Source: ours.
JOINT_MEMORY = 0.5  #: Time for which joint positions are kept [s]. Source: ours; images arrive sooner.
LENS_TOLERANCE = 0.02  #: Relative difference of focal lengths, and of centres by the width. Source: ours.
EARLIEST, LATEST = -0.05, 0.5  #: Range of an image's age at arrival by a good stamp [s]. Source: ours.
NUM_EQUAL = 4  #: Equal images in a row of a frozen camera; others may repeat one. Source: ours.
DISTRUST_TIME = 1.0  #: Time for which images are refused after one older than the last [s]. Source: ours.
ROUNDING = 1e-9  #: Difference up to which two times are equal [s].
LONGEST_WAIT = 0.25 * CONTROL_DT  #: Time after which a waiting image is dropped [s]. Source: ours.


class ImageSubscriber:
    """Receives images, checks that they come from one working camera, and adds the joint positions then."""

    def __init__(
        self,
        transport: Transport,
        profile: CameraProfile,
        camera: CameraSpec,
        clock: Clock,
        *,
        assumes_age: bool = False,
    ) -> None:
        """Subscribe; the policy was trained for this camera, and the clock is that of the images' stamps.

        With `assumes_age`, images without a usable stamp count as `ASSUMED_AGE` control steps old at arrival.
        Without, their stamp is used as it is, and the servo refuses them.
        """
        self._transport, self._profile, self._camera, self._clock = transport, profile, camera, clock
        self._images = transport.subscription(profile.image, DEPTH)
        self._lens = transport.subscription(profile.info) if profile.info else None
        self._joints: deque[tuple[float, Joints]] = deque()
        self._last: Image | None = None
        self._num_equal, self._next_poll, self._distrusted_until = 1, -inf, -inf
        self._several_cameras = self._wrong_size = self._older = self._wrong_lens = self._ahead = ""
        self._assumes_age, self._is_stamped, self._notice = assumes_age, False, ""
        self.received: list[Message] = []  #: Messages that the last call of `newest` took, for a recording.
        self.message = ""  #: Why the last image could not be read; empty if it could.
        self.stamp = -inf  #: Exposure time of the newest usable image [s].

    def add_joints(self, time: float, joint_pos: Joints) -> None:
        """Keep measured joint positions [rad] of a time [s], for the images of that time."""
        self._joints.append((time, joint_pos))
        while self._joints[0][0] < time - JOINT_MEMORY:
            self._joints.popleft()

    @property
    def problem(self) -> str:
        """Why no image can be used, such as another lens than the calibrated one; empty if they can."""
        if self._num_equal >= NUM_EQUAL:
            name = self._profile.image.name
            return f"the image on {name} is frozen: its pixels do not change. Restart the camera's driver."
        older = self._older if self._clock.now() < self._distrusted_until else ""
        return self._several_cameras or self._wrong_size or older or self._wrong_lens or self._ahead

    def newest(self) -> Image | None:
        """Return the newest image since the last call, stamped by `Clock.now`; None without a usable one."""
        self._check_camera()
        self.received = self._images.take()
        newest: Image | None = None
        for message in self.received:
            try:
                image = messages.read_image(message.data)
            except DeploymentError as error:
                self.message = str(error)
                continue
            self.message = self._ahead = ""
            is_new = self._is_new(image)
            if self.problem:
                continue
            stamp = self._exposure_time(image, message.arrival)
            if (ahead := stamp - self._clock.now()) > -EARLIEST:
                name = self._profile.image.name
                self._ahead = f"images on {name} are {ahead:.2g} s in the future: synchronise the clocks."
                continue
            self.stamp = stamp
            if is_new:
                readout_time, joint_pos = self._profile.readout_time, self._joints_at(stamp)
                newest = replace(image, stamp=stamp, readout_time=readout_time, joint_pos=joint_pos)
        return None if self.problem else newest

    def take_notice(self) -> str:
        """Return once that the camera's stamps are unusable; empty otherwise."""
        notice, self._notice = self._notice, ""
        return notice

    def _check_camera(self) -> None:
        """Compare the lens; from time to time, count the cameras."""
        for message in self._lens.take() if self._lens else ():
            try:
                self._wrong_lens = lens_difference(messages.read_camera_info(message.data), self._camera)
            except DeploymentError as error:
                self._wrong_lens = str(error)
        if (now := self._clock.now()) < self._next_poll:
            return
        self._next_poll = now + POLL_TIME
        topics = [topic for topic in (self._profile.image, self._profile.info) if topic]
        shared = [topic.name for topic in topics if self._transport.num_other_publishers(topic) > 1]
        self._several_cameras = f"several publish {' and '.join(shared)}: end all but one." if shared else ""

    def _is_new(self, image: Image) -> bool:
        """Check the next image; return whether it differs from the previous one."""
        last, self._last, self._wrong_size = self._last, image, self._profile.wrong_format(image)
        if last is None or self._wrong_size:
            self._num_equal = 1
            return not self._wrong_size
        if 0.0 < image.stamp < last.stamp:
            self._distrusted_until = self._clock.now() + DISTRUST_TIME
            self._older = (
                f"an image on {self._profile.image.name} is {last.stamp - image.stamp:.2g} s older than "
                "the one before: end a second camera or recording; or a clock was set, wait a second."
            )
        is_repeated = image.stamp == last.stamp != 0.0
        is_equal = np.array_equal(last.pixels, image.pixels)
        self._num_equal = self._num_equal + (not is_repeated) if is_equal else 1
        return not is_equal

    def _exposure_time(self, image: Image, arrival: float) -> float:
        """Exposure time by the stamp; after the first usable stamp, an old one is a late image."""
        stamp = self._clock.now() - (self._clock.stamp() - image.stamp) - self._profile.stamp_offset
        has_stamp, was_stamped, age = image.stamp != 0.0, self._is_stamped, arrival - stamp
        is_usable = has_stamp and EARLIEST <= age <= LATEST
        self._is_stamped = is_usable or (was_stamped and has_stamp)
        if self._is_stamped or not self._assumes_age:
            return stamp
        if was_stamped or self.stamp == -inf:
            found = (
                f"stamps of {abs(age):.2g} s {'ago' if age > 0.0 else 'ahead'}" if has_stamp else "no stamps"
            )
            self._notice = (
                f"images on {self._profile.image.name} have {found}: each counts as "
                f"{1e3 * ASSUMED_AGE * CONTROL_DT:.0f} ms old at arrival. Let the driver write the exposure "
                "time into header.stamp, and synchronise the clocks of the two machines."
            )
        return arrival - ASSUMED_AGE * CONTROL_DT

    def _joints_at(self, time: float) -> Joints | None:
        _, joint_pos = min(
            self._joints, key=lambda known: abs(known[0] - time), default=(0.0, np.array(np.nan))
        )
        return None if np.isnan(joint_pos).any() else joint_pos


def lens_difference(found: CameraSpec, expected: CameraSpec) -> str:
    """Return how a camera's lens differs from the expected one, and what to do; empty if it does not."""
    theirs, ours = ((each.fx, each.fy, each.cx, each.cy) for each in (found, expected))
    scale = np.array((expected.fx, expected.fy, expected.width, expected.width))
    if (np.abs(np.subtract(theirs, ours)) <= LENS_TOLERANCE * scale).all():
        return ""
    given, wanted = (", ".join(f"{number:.1f}" for number in each) for each in (theirs, ours))
    return (
        f"the camera has fx, fy, cx, cy of {given}, the policy's camera {wanted}: calibrate the camera, and "
        "train with 'train --camera'."
    )


class InlineExecutor(Executor):
    """Runs work at once in the caller's thread, for stepped time."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future = Future[Any]()
        future.set_result(fn(*args, **kwargs))
        return future


INLINE = InlineExecutor()


class PerceptionRunner:
    """Runs perception on one image at a time. Of the images that arrive meanwhile, the newest waits.

    A result counts after a stated time of the clock, so that stepped time can rehearse slow perception.
    """

    def __init__(
        self,
        pipeline: PolicyPipeline,
        clock: Clock,
        executor: Executor = INLINE,
        duration: Callable[[], float] = float,
    ) -> None:
        """Start without an image; `duration` draws the least time that perception takes [s]."""
        self._pipeline, self._clock, self._executor, self._duration = pipeline, clock, executor, duration
        self._waiting: tuple[Image, float] | None = None
        self._running: Future[Box] | None = None
        self._image: Image | None = None
        self._due = -inf
        self._started: dict[str, float] = {}
        self._on_end: Callable[[], None] | None = None
        #: Of the image of the newest box: its exposure and arrival, begin and end of its perception [s].
        self.times: dict[str, float] = {}

    @property
    def stamp(self) -> float | None:
        """Exposure time of the image that is being processed [s]; None without one."""
        return self._started["exposed"] if self._running else None

    def wait(self, seconds: float) -> None:
        """Wait for the result, at most for a real time [s]."""
        if self._running and not self._running.done():
            wait((self._running,), seconds)
        else:
            self._clock.sleep_until(min(self._due, self._clock.now() + seconds))

    def begin_throw(self, prompt: BoxPrompt | None) -> None:
        """Start a new throw; the result of an image that is being processed will be dropped."""
        self._pipeline.begin_throw()
        point = partial(self._pipeline.point, prompt)
        if self._running:
            self._on_end = point
        else:
            point()

    def offer(self, image: Image) -> None:
        """Process an image that has just arrived, unless a newer one arrives before its turn."""
        self._waiting = (image, self._clock.now())

    def poll(self) -> Box | None:
        """Give a new box of this throw to the pipeline and return it; start with the next image."""
        box = self._finish()
        now = self._clock.now()
        if self._waiting and now - self._waiting[1] > LONGEST_WAIT:
            self._waiting = None
        if self._waiting and not self._running:
            self._start(*self._waiting, now)
        return box

    def _start(self, image: Image, received: float, now: float) -> None:
        self._waiting, self._image = None, image
        self._started = {"exposed": image.stamp, "received": received, "begun": now}
        self._running = self._executor.submit(self._pipeline.tracker.step, image, now)
        self._due = now + self._duration()
        self._running.add_done_callback(lambda _: self._pipeline.tracker.settle())  # while the policy decides

    def _finish(self) -> Box | None:
        if not (self._running and self._running.done() and self._clock.now() >= self._due - ROUNDING):
            return None
        box, self._running = self._running.result(), None
        if box.verdict is Verdict.SEEN and self._image:
            row, image = 0.5 * (box.edges[1] + box.edges[3]), self._image
            later = image.readout_time * (row / len(image.pixels) - 0.5)
            box = replace(box, stamp=image.stamp + later)
        if self._on_end:
            self._on_end()
            self._on_end = None
            return None
        self._pipeline.add_box(box)
        self.times = {**self._started, "perceived": self._clock.now()}
        return box
