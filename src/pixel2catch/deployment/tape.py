"""What goes on a recording: all that was heard, seen, decided and commanded, as it was on the network."""

from typing import Literal

import numpy as np

from pixel2catch.deployment import messages
from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.compressed import compress, compressed_topic
from pixel2catch.deployment.profile import Profile
from pixel2catch.deployment.recorder import Convert, Recorder
from pixel2catch.deployment.transport import Packet, Topic, Transport

SERVO = Topic(name="/pixel2catch/servo", type=messages.FLOAT_ARRAY)
"""Every tick of the servo, `Decision.row`."""

ORDERS = Topic(name="/pixel2catch/orders", type=messages.FLOAT_ARRAY)
"""What the servo was told, `Orders.row`."""

DEPTH = 512
"""Messages that are kept between two control steps."""

RESOLUTION = 1e-6
"""Least time between two messages of a topic [s]: readers of bags sort by it."""

Images = Literal["jpeg", "raw", "none"]
"""How images are recorded; raw ones are 27 MB a second."""


class Tape:
    """Records a deployment; what is sent over the network is recorded as everybody else hears it."""

    def __init__(
        self, recorder: Recorder, transport: Transport, profile: Profile, clock: Clock, images: Images
    ) -> None:
        """Begin to listen to joint states, commands and operator."""
        self._recorder, self._clock = recorder, clock
        self._profile, self._images = profile, images
        self._last: dict[Topic, float] = {}
        operator = profile.operator
        topics = {topic for part in profile.robots for topic in (part.state_topic, part.command_topic)} | {
            operator.arm,
            operator.dead_man,
            operator.stop,
            operator.prompt,
            operator.status,
        }
        topics |= {topic for topic in vars(profile.status).values() if topic}
        self._subscriptions = [(topic, transport.subscription(topic, DEPTH)) for topic in topics]

    def roll(self) -> None:
        """Record what has arrived since the last call."""
        for topic, subscription in self._subscriptions:
            for packet in subscription.take():
                self._write(topic, packet.data, packet.arrival)

    def see(self, packets: list[Packet]) -> None:
        """Record images."""
        topic = self._profile.camera.image
        for packet in packets:
            if self._images == "jpeg":
                self._write(compressed_topic(topic), packet.data, packet.arrival, compress)
            elif self._images == "raw":
                self._write(topic, packet.data, packet.arrival)

    def note(self, topic: Topic, row: np.ndarray, time: float) -> None:
        """Record numbers of this time, `Clock.now` [s]."""
        self._write(topic, messages.float_array(row), time)

    def _write(self, topic: Topic, data: bytes, time: float, convert: Convert = bytes) -> None:
        """Record a message of a moment of `Clock.now` [s]; those of one moment keep their order."""
        stamp = self._clock.stamp() - (self._clock.now() - time)
        self._last[topic] = max(stamp, self._last.get(topic, stamp) + RESOLUTION)
        self._recorder.record(topic, data, self._last[topic], convert)
