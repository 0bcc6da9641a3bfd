"""What a lab's recordings call our topics and joints."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification.recording import JOINT_SPECS, ROBOTS

MEASURED_TOPIC = "/joint_states"
"""Topic of the measurements. Source: ROS 2, `joint_state_broadcaster`."""


@dataclass(frozen=True, kw_only=True)
class CommandTopic:
    """A topic on which commands were sent.

    Attributes:
        name: Its name.
        joints: Our names of the joints in messages that name none, in their order; empty if they are the
            robot's joints, or if the messages name them.
    """

    name: str
    joints: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Names:
    """What a recording calls things.

    Attributes:
        command_topics: Topics of the commands of a bag; may be empty if only one can be it.
        measured_topic: Topic of the measurements of a bag.
        theirs: The recording's names of joints that have another name there, by ours.
    """

    command_topics: tuple[CommandTopic, ...] = ()
    measured_topic: str = MEASURED_TOPIC
    theirs: Mapping[str, str] = field(default_factory=dict)

    def ours(self, names: Iterable[str]) -> tuple[str, ...]:
        """Our names of recorded joints; one that is not ours is kept, but is never mistaken for ours."""
        renamed = {theirs: ours for ours, theirs in self.theirs.items()}
        shadowed = {ours: f"recorded {ours}" for ours in self.theirs}
        return tuple((shadowed | renamed).get(name, name) for name in names)

    @classmethod
    def parse(cls, command_topics: Sequence[str], measured_topic: str, renames: Sequence[str]) -> "Names":
        """Read the options of the command line.

        Args:
            command_topics: Each `TOPIC`, `TOPIC=ROBOT` or `TOPIC=JOINT,JOINT,…` with the recording's names.
            measured_topic: Topic of the measurements.
            renames: Each `OURS=THEIRS`.

        Raises:
            UnknownNameError: If a joint that is renamed is none of ours.
            InvalidValueError: If an option is of another form, or names something twice.
        """
        pairs = [_pair(rename) for rename in renames]
        for ours, _ in pairs:
            if ours not in JOINT_SPECS:
                raise UnknownNameError("joint", ours, JOINT_SPECS)
        _require_once("--rename", [ours for ours, _ in pairs])
        _require_once("--rename", [theirs for _, theirs in pairs])
        names = cls(measured_topic=measured_topic, theirs=dict(pairs))
        topics = tuple(names._topic(text) for text in command_topics)
        _require_once("--command-topic", [topic.name for topic in topics])
        return cls(command_topics=topics, measured_topic=measured_topic, theirs=names.theirs)

    def _topic(self, text: str) -> CommandTopic:
        name, _, joints = text.partition("=")
        if not joints:
            return CommandTopic(name=name)
        return CommandTopic(name=name, joints=ROBOTS.get(joints) or self.ours(joints.split(",")))


def _pair(rename: str) -> tuple[str, str]:
    ours, _, theirs = rename.partition("=")
    if not ours or not theirs:
        raise InvalidValueError(
            f"--rename {rename}: not of the form OURS=THEIRS, such as index_joint_1=joint_1.0"
        )
    return ours, theirs


def _require_once(option: str, names: Sequence[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InvalidValueError(f"{option} names {', '.join(twice)} twice; name each once")
