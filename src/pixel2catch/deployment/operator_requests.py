"""What is asked of a control loop: one program points at the object, whoever asks to stop is named."""

from collections.abc import Iterator
from contextlib import suppress
from math import inf

from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.errors import DeploymentError
from pixel2catch.perception.segmenter import BoxPrompt, Prompt
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import OperatorTopics
from pixel2catch.ros2.transport import Message, Transport

DEPTH = 16  #: Messages kept from one look to the next: several senders may share a topic. Source: ours.
GONE = "a program that is not known"  #: Who has left before somebody looked, or has no name on the network.


class OperatorRequests:
    """Heeds the prompts of one publisher, and says who asked the servo to stop.

    The first that points at something keeps the right to for as long as it is there. Where the network does
    not tell who sent a message, prompts of several publishers are refused.
    """

    def __init__(self, transport: Transport, topics: OperatorTopics, statistics: RunStatistics) -> None:
        """Begin to listen; what is refused, and who asked to stop, is counted."""
        self._transport, self._topics, self._statistics = transport, topics, statistics
        self._prompts = transport.subscription(topics.prompt, DEPTH)
        self._stops = transport.subscription(topics.stop, DEPTH, only_watches=True)
        self._pointer = 0
        self.complaint = ""  #: Why the last prompt was not heeded; empty if it was.
        self.stopped_by = ""  #: Who asked to stop last, as a sentence; empty if nobody did.

    def take(self) -> Iterator[Prompt]:
        """Where the object is said to be, message by message, since the last call; note who asks to stop."""
        for message in self._stops.take():
            if _asks(message):
                who = self._transport.other_publishers(self._topics.stop).get(message.sender, GONE)
                self.stopped_by = f"The stop was asked for by {who}."
                self._statistics.stop_requests[who] += 1
        for message in self._prompts.take():
            self.complaint = self._refusal(message)
            if not self.complaint:
                try:
                    yield read_prompt(message.data)
                except DeploymentError as error:
                    self.complaint = str(error)

    def _refusal(self, message: Message) -> str:
        """Why a prompt is not heeded, whatever it says; empty if it is."""
        known, sender = self._transport.other_publishers(self._topics.prompt), message.sender
        if sender and self._pointer not in known:
            self._pointer = sender
        if sender == self._pointer and (sender or len(known) < 2):
            return ""
        who = known.get(sender, GONE) if sender else " or ".join(known.values())
        self._statistics.refused_prompts[who] += 1
        return (
            f"a prompt of {who} was refused: {known.get(self._pointer, 'only one program')} points at the "
            "object. End one of them; a program that was killed counts for 10 s."
        )


def _asks(message: Message) -> bool:
    """Whether a message can be read, and asks to stop."""
    with suppress(DeploymentError):
        return messages.read_boolean(message.data)
    return False


def read_prompt(data: bytes) -> Prompt:
    """Read where the operator points.

    Raises:
        DeploymentError: It is no box of an image.
    """
    try:
        xmin, ymin, xmax, ymax = map(float, messages.read_json(data)["box"])
    except (DeploymentError, ValueError, TypeError, KeyError, OverflowError) as error:
        raise DeploymentError(
            f'a prompt is not {{"box": [xmin, ymin, xmax, ymax]}} in pixels ({error}).'
        ) from error
    if not (-inf < xmin < xmax < inf and -inf < ymin < ymax < inf):
        raise DeploymentError(f"the prompt's box {xmin:g} {ymin:g} {xmax:g} {ymax:g} is empty, or endless.")
    return BoxPrompt(box=(xmin, ymin, xmax, ymax))
