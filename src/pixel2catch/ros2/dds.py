"""The network of ROS 2 by DDS, without an installation of ROS 2. Needs cyclonedds.

A node is used by one thread. Messages are received in the background, between two calls of `take`. Their
arrival is the sender's stamp, clipped to that interval.
"""

import os
from collections.abc import Collection
from functools import cache
from typing import Any, final

from cyclonedds import builtin
from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic
from rosbags.interfaces import Nodetype

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.messages import STORE
from pixel2catch.ros2.transport import (
    ANY,
    LOOPBACK,
    Endpoint,
    Message,
    Publisher,
    RealClock,
    Subscription,
    Topic,
    Transport,
)

PLAIN_TYPES = {
    "bool": bool,
    "string": str,
    "byte": types.byte,
    "char": types.uint8,
    "float32": types.float32,
    "float64": types.float64,
} | {f"{sign}int{bits}": getattr(types, f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)}
"""Types of fields that are not messages. Source: ROS 2's mapping to IDL."""


@cache
def dds_type(name: str) -> Any:
    """Return the DDS type of a message: `sensor_msgs/msg/Image` is `sensor_msgs::msg::dds_::Image_`.

    It is a type of cyclonedds, made from bytes, which are its attribute `cdr`.
    """
    package, kind, short = name.split("/")
    fields = {field: _field_type(description) for field, description in STORE.fielddefs[name][1]}
    made: Any = make_idl_struct(f"{short}_", f"{package}.{kind}.dds_.{short}_", fields, dataclassify=False)
    # No base class, as DDS would announce it as a base of the message.
    made.__init__ = lambda sample, cdr: setattr(sample, "cdr", cdr)
    made.serialize = lambda sample, **_: sample.cdr
    made.deserialize = made.deserialize_key = classmethod(lambda kind, data, **_: kind(data))  # pyright: ignore[reportCallIssue]
    return made


def _field_type(description: Any) -> Any:
    kind, content = description
    if kind == Nodetype.BASE:
        return PLAIN_TYPES[content[0]]
    if kind == Nodetype.NAME:
        return dds_type(content)
    if kind == Nodetype.ARRAY:
        return types.array[_field_type(content[0]), content[1]]
    return types.sequence[_field_type(content[0])]


LARGEST_DOMAIN = 232  #: Largest domain whose ports exist. Source: DDS-RTPS.
LONGEST_NAME = 60  #: Longest part of a participant's description that is shown [characters]. Source: ours.
HANDLES = 2**64  #: Message handles are unsigned, entity handles signed: compare modulo this number.
MOST_ENDPOINTS = 10_000  #: Largest number of endpoints that are listed; a laboratory has some hundreds.

THIS_MACHINE = """
<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast><MaxMessageSize>65500B</MaxMessageSize>
  </General>
  <Discovery>
    <Tag>pixel2catch</Tag><Peers><Peer address="127.0.0.1"/></Peers>
    <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
  </Discovery>
  <Internal><SocketReceiveBufferSize max="8MB"/></Internal>
</Domain></CycloneDDS>
"""
"""This machine only: no multicast, and a buffer for a few images. The tag separates a rehearsal from a
robot's driver on this machine, which may also use this interface."""

ONE_INTERFACE = """<CycloneDDS xmlns="https://cdds.io/config"><Domain Id="any">
  <General><Interfaces><NetworkInterface name="{name}"/></Interfaces></General>
  <Internal><SocketReceiveBufferSize max="8MB"/></Internal>
</Domain></CycloneDDS>
"""

ONLY_WATCHES = "watches=1;"  #: User data of subscriptions that do not count as a source of commands (ours).

NEVER_BLOCK = Policy.Reliability.Reliable(max_blocking_time=0)  #: A slow reader loses messages.

NEW = SampleState.NotRead | ViewState.Any | InstanceState.Alive  #: Messages, not the end of a publisher.
ALIVE = SampleState.Any | ViewState.Any | InstanceState.Alive  #: Participants that have not left.


def _only_watches(qos: Qos) -> bool:
    data: Any = qos[Policy.Userdata]
    return data is not None and ONLY_WATCHES.encode() in data.data


def _description(qos: Collection[Any]) -> str:
    """Describe a participant: its name, or its program's, the process, and the machine."""
    properties = {each.key: each.value for each in qos if isinstance(each, Policy.Property)}
    name = next((each.name for each in qos if isinstance(each, Policy.EntityName)), "")
    parts = [properties.get(key, "?") for key in ("__ProcessName", "__Pid", "__Hostname")]
    parts = ["".join(filter(str.isprintable, text))[:LONGEST_NAME] for text in (name or parts[0], *parts[1:])]
    return "{} (process {} on {})".format(*parts)


@cache
def _configured_domain(number: int, network: str) -> Domain:
    """Limit a domain to a network: once in a process, before its first node."""
    config = THIS_MACHINE if network == LOOPBACK else ONE_INTERFACE.format(name=network)
    try:
        return Domain(number, config)
    except DDSException as error:
        raise DeploymentError(
            f"DDS domain {number} cannot be limited to the network '{network}' ({error}): another node of "
            "this process has opened it, or there is no such interface; choose another ROS_DOMAIN_ID."
        ) from error


def join(node_name: str, clock: RealClock, network: str) -> Transport:
    """Join the domain ROS_DOMAIN_ID on this machine only, one interface, or any, as CYCLONEDDS_URI says."""
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > LARGEST_DOMAIN:
        raise DeploymentError(f"ROS_DOMAIN_ID is '{text}'; set it to a number from 0 to {LARGEST_DOMAIN}.")
    if network != ANY:
        _configured_domain(int(text), network)
    qos = Qos(Policy.Userdata(b"enclave=/;"), Policy.EntityName(node_name))
    try:
        return _DdsTransport(DomainParticipant(int(text), qos), clock)
    except DDSException as error:
        raise DeploymentError(
            f"DDS cannot join domain {text} ({error}); check the network interfaces, "
            "CYCLONEDDS_URI, and whether this machine has more than 30 nodes."
        ) from error


@final
class _DdsTransport(Transport):
    def __init__(self, participant: DomainParticipant, clock: RealClock) -> None:
        self._participant, self._clock = participant, clock
        self._news = WaitSet(self._participant)
        self._kept: list[Publisher | Subscription] = []  # the library removes endpoints without references
        self._watchers: dict[Topic, DataReader] = {}

    def publisher(self, topic: Topic) -> Publisher:
        writer = DataWriter(self._participant, self._dds_topic(topic), _qos(topic, 1, NEVER_BLOCK))
        self._kept.append(publisher := _DdsPublisher(topic, writer))
        return publisher

    def subscription(self, topic: Topic, depth: int = 1, *, only_watches: bool = False) -> Subscription:
        reader = self._reader(topic, depth, only_watches=only_watches)
        if not only_watches:
            self._news.attach(ReadCondition(reader, NEW))
        self._kept.append(subscription := _DdsSubscription(reader, depth, self._clock))
        return subscription

    def num_other_publishers(self, topic: Topic) -> int:
        # cheaper than to describe them; one that was killed counts for 10 s more
        return len(self._watcher(topic).get_matched_publications())

    def other_publishers(self, topic: Topic) -> dict[int, str]:
        watcher, found = self._watcher(topic), dict[int, str]()
        participants = {each.key: each.qos for each in self._listed(builtin.BuiltinTopicDcpsParticipant)}
        for each in watcher.get_matched_publications():
            data = watcher.get_matched_publication_data(each)
            found[each % HANDLES] = _description(participants.get(data.participant_key, ()) if data else ())
        return found

    def endpoints(self) -> list[Endpoint]:
        return [
            Endpoint(
                topic=each.topic_name.removeprefix("rt"),
                type=each.type_name.removesuffix("_").replace("dds_::", "").replace("::", "/"),
                is_publisher=kind is builtin.BuiltinTopicDcpsPublication,
                program=str(each.participant_key),
            )
            for kind in (builtin.BuiltinTopicDcpsPublication, builtin.BuiltinTopicDcpsSubscription)
            for each in self._listed(kind)
            if each.participant_key != self._participant.guid
            and each.topic_name.startswith("rt/")
            and not _only_watches(each.qos)
        ]

    def _listed(self, kind: Any) -> list[Any]:
        reader = builtin.BuiltinDataReader(self._participant, kind)
        return reader.read(MOST_ENDPOINTS, ReadCondition(reader, ALIVE))

    def wait(self, seconds: float) -> bool:
        return self._news.wait(max(0, round(seconds * 1e9))) > 0

    def close(self) -> None:
        self._participant.__del__()  # the only way of the library while publishers are referenced

    def _watcher(self, topic: Topic) -> DataReader:
        """Return a reader that finds the publishers of others; its messages are not taken."""
        if topic not in self._watchers:
            self._watchers[topic] = self._reader(topic, 1, Policy.IgnoreLocal.Participant, only_watches=True)
        return self._watchers[topic]

    def _reader(self, topic: Topic, depth: int, *policies: object, only_watches: bool) -> DataReader:
        """Return a reader: best effort, to receive from every publisher, or reliable for latched messages."""
        reliability = NEVER_BLOCK if topic.is_latched else Policy.Reliability.BestEffort
        qos = _qos(topic, depth, reliability, *policies, note=ONLY_WATCHES if only_watches else "")
        return DataReader(self._participant, self._dds_topic(topic), qos)

    def _dds_topic(self, topic: Topic) -> DdsTopic:
        return DdsTopic(self._participant, f"rt{topic.name}", dds_type(topic.type))


@final
class _DdsPublisher(Publisher):
    def __init__(self, topic: Topic, writer: DataWriter) -> None:
        self._topic, self._writer = topic, writer
        self._type = dds_type(topic.type)
        self._programs: dict[int, str] = {}

    def publish(self, data: bytes) -> None:
        try:
            self._writer.write(self._type(data))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:  # a reader is too slow
                raise DeploymentError(f"{self._topic.name} cannot be sent ({error}).") from error

    def num_subscribers(self) -> int:
        handles = self._writer.get_matched_subscriptions()
        known = self._programs  # each subscription is examined once
        self._programs = {each: known.get(each) or self._program(each) for each in handles}
        return len({program for program in self._programs.values() if program})

    def _program(self, handle: int) -> str:
        """Return the participant of a subscription; its own number if unknown, empty if it only watches."""
        found = self._writer.get_matched_subscription_data(handle)
        if not found:
            return str(handle)
        return "" if _only_watches(found.qos) else str(found.participant_key)


@final
class _DdsSubscription(Subscription):
    def __init__(self, reader: DataReader, depth: int, clock: RealClock) -> None:
        self._reader, self._clock = reader, clock
        self._most = depth + 1  # one more for the end of a publisher, which is not a message
        self._taken = clock.now()

    def take(self) -> list[Message]:
        samples = [each for each in self._reader.take(N=self._most) if not isinstance(each, InvalidSample)]
        now, before = self._clock.now(), self._taken
        self._taken = now
        ages = [self._clock.age(each.sample_info.source_timestamp) for each in samples]
        senders = [each.sample_info.publication_handle for each in samples]
        return [
            Message(data=sample.cdr, arrival=min(max(now - age, before), now), age=age, sender=sender)
            for sample, age, sender in zip(samples, ages, senders, strict=True)
        ]


def _qos(topic: Topic, depth: int, *policies: object, note: str = "") -> Qos:
    """Return the quality of service of an endpoint, with its message's type hash for ROS 2 Jazzy."""
    durability = Policy.Durability.TransientLocal if topic.is_latched else Policy.Durability.Volatile
    definition = Policy.Userdata(f"typehash={STORE.hash_rihs01(topic.type)};{note}".encode())
    return Qos(durability, Policy.History.KeepLast(depth), definition, *policies)
