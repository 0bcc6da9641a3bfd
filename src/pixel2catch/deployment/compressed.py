"""Images as JPEG, for recordings: a fifth of the size of raw ones."""

from dataclasses import replace

import cv2
import numpy as np

from pixel2catch.deployment import messages
from pixel2catch.deployment.cdr import decode, encode, header, seconds
from pixel2catch.deployment.transport import Topic
from pixel2catch.errors import DeploymentError

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

FORMAT = "rgb8; jpeg compressed bgr8"
"""What was compressed, and how. Source: image_transport."""

SUFFIX = "/compressed"
"""What the topic of compressed images is called behind that of the raw ones. Source: image_transport."""


def compressed_topic(topic: Topic) -> Topic:
    """The topic of the compressed images of a topic."""
    return replace(topic, name=topic.name + SUFFIX, type=COMPRESSED_IMAGE)


def compress(data: bytes) -> bytes:
    """An image message as a JPEG message.

    Raises:
        DeploymentError: It is damaged, or of another encoding than `messages.CHANNELS`.
    """
    reading = messages.read_image(data)
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(reading.pixels, cv2.COLOR_RGB2BGR))
    return encode(
        COMPRESSED_IMAGE, header(reading.stamp, messages.OPTICAL_FRAME), "rgb8; jpeg compressed bgr8", jpeg
    )


def uncompress(data: bytes) -> bytes:
    """A JPEG message as an image message.

    Raises:
        DeploymentError: It is damaged.
    """
    message = decode(data, COMPRESSED_IMAGE)
    jpeg = np.frombuffer(bytes(message.data), dtype=np.uint8)
    pixels = cv2.imdecode(jpeg, cv2.IMREAD_COLOR) if len(jpeg) else None
    if pixels is None:
        raise DeploymentError("a compressed image cannot be read: it is damaged.")
    return messages.image(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), seconds(message.header))
