"""The network of ROS 2 by DDS, without an installation of ROS 2. Needs cyclonedds.

A node of this transport is used by one thread. Messages are received in the background, whatever this process
does. They arrive between two calls of `take`; the sender's time says when, and is believed only within these.
"""

import os
from collections.abc import Collection
from functools import cache
from typing import Any, final

import numpy as np
from cyclonedds import builtin
from cyclonedds.core import (
    DDSException,
    Entity,
    InstanceState,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

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
"""The types of fields that are no messages. Source: ROS 2's mapping to IDL."""


@cache
def dds_type(name: str, store: Typestore = STORE) -> Any:
    """Describe a message to DDS: `sensor_msgs/msg/Image` is `sensor_msgs::msg::dds_::Image_`.

    It is a type of cyclonedds, made from bytes, which are its attribute `cdr`.
    """
    package, kind, short = name.split("/")
    fields = {field: _field_type(description, store) for field, description in store.fielddefs[name][1]}
    made: Any = make_idl_struct(f"{short}_", f"{package}.{kind}.dds_.{short}_", fields, dataclassify=False)
    # Not by a base class: DDS would announce that as a base of the message.
    made.__init__ = lambda sample, cdr: setattr(sample, "cdr", cdr)
    made.serialize = lambda sample, **_: sample.cdr
    made.deserialize = made.deserialize_key = classmethod(_of_bytes)
    return made


def _of_bytes(kind: Any, data: bytes, **_: Any) -> Any:
    return kind(data)


def _field_type(description: Any, store: Typestore) -> Any:
    kind, content = description
    if kind == Nodetype.BASE:
        return PLAIN_TYPES[content[0]]
    if kind == Nodetype.NAME:
        return dds_type(content, store)
    if kind == Nodetype.ARRAY:
        return types.array[_field_type(content[0], store), content[1]]
    return types.sequence[_field_type(content[0], store)]


MESSAGE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
MESSAGE_HASH = "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"
"""Hash of its definition, without which each node of ROS 2 warns. Source: rosidl 4.6.5 (Jazzy); rosbags has
another one, as it takes a `char` for a type of its own."""


class NodeAnnouncement:
    """Tells ROS's tools the name of a node, and which publishers and subscriptions are its own.

    The message differs between versions of ROS 2, and the wrong one crashes nodes of Humble: make it by `of`.
    """

    def __init__(self, participant: DomainParticipant, node_name: str, store: Any) -> None:
        """Announce a node without endpoints."""
        self._participant, self._name, self._store = participant, node_name, store
        self._readers: list[Any] = []
        self._writers: list[Any] = []
        self._type = dds_type(MESSAGE, store)
        topic = DdsTopic(participant, "ros_discovery_info", self._type)
        latched = Policy.Durability.TransientLocal, NEVER_BLOCK, Policy.History.KeepLast(1)
        self._writer = DataWriter(participant, topic, Qos(*latched, _definition(MESSAGE_HASH)))
        self._announce()

    @classmethod
    def of(cls, participant: DomainParticipant, node_name: str) -> "NodeAnnouncement | None":
        """Announce a node to the ROS 2 of ROS_DISTRO; None, and nothing sent, if that is unknown."""
        try:
            store = get_typestore(Stores(f"ros2_{os.environ.get('ROS_DISTRO', '')}"))
        except ValueError:
            return None
        return cls(participant, node_name, store) if MESSAGE in store.types else None

    def add(self, endpoint: DataReader | DataWriter) -> None:
        """Announce a subscription or a publisher of the node."""
        known = self._readers if isinstance(endpoint, DataReader) else self._writers
        known.append(self._gid(endpoint))
        self._announce()

    def _gid(self, entity: Entity) -> Any:
        """An entity's identity in 16 bytes, in Humble 24."""
        kind = "rmw_dds_common/msg/Gid"
        ((_, (_, (_, size))),) = self._store.fielddefs[kind][1]
        data = np.frombuffer(entity.guid.bytes.ljust(size, b"\0"), dtype=np.uint8)
        return self._store.types[kind](data=data)

    def _announce(self) -> None:
        node = self._store.types["rmw_dds_common/msg/NodeEntitiesInfo"](
            node_namespace="/",
            node_name=self._name,
            reader_gid_seq=self._readers,
            writer_gid_seq=self._writers,
        )
        message = self._store.types[MESSAGE](gid=self._gid(self._participant), node_entities_info_seq=[node])
        self._writer.write(self._type(bytes(self._store.serialize_cdr(message, MESSAGE))))


LARGEST_DOMAIN = 232  #: Largest domain whose ports exist. Source: DDS-RTPS.

THIS_MACHINE = """
<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
    <MaxMessageSize>65500B</MaxMessageSize>
  </General>
  <Discovery>
    <Tag>pixel2catch</Tag>
    <ParticipantIndex>auto</ParticipantIndex>
    <MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
  <Internal><SocketReceiveBufferSize max="8MB"/></Internal>
</Domain></CycloneDDS>
"""
"""This machine only: no multicast, and room for a few images that nobody has read yet. The tag keeps a
rehearsal from a robot's driver on this machine, which may listen on this interface, too."""

ONE_INTERFACE = """<CycloneDDS xmlns="https://cdds.io/config"><Domain Id="any">
  <General><Interfaces><NetworkInterface name="{name}"/></Interfaces></General>
  <Internal><SocketReceiveBufferSize max="8MB"/></Internal>
</Domain></CycloneDDS>
"""
"""One interface of this machine, with all that is reached by it."""

ONLY_WATCHES = "watches=1;"  #: In the user data of subscriptions that do not count. Source: ours.

NEVER_BLOCK = Policy.Reliability.Reliable(max_blocking_time=0)
"""A slow reader may lose messages; it does not hold up the writer."""

NEW = SampleState.NotRead | ViewState.Any | InstanceState.Alive
"""What ends a wait: a message, but not that a publisher has left."""


THERE = SampleState.Any | ViewState.Any | InstanceState.Alive  #: Who has not left.
LONGEST_NAME = 60  #: Characters of what somebody else calls himself that are shown. Source: ours.
HANDLES = 2**64  #: Handles are counted up to it by messages, and from minus a half of it on by entities.
MOST_ENDPOINTS = 10_000  #: Endpoints that are listed at the most; a laboratory has some hundreds.


def _only_watches(qos: Qos) -> bool:
    """Whether a subscription says of itself that it does not count."""
    said: Any = qos[Policy.Userdata]
    return said is not None and ONLY_WATCHES.encode() in said.data


def _in_words(qos: Collection[Any]) -> str:
    """What a participant says of itself: its name, or its program's, the process, and the machine."""
    told = {each.key: each.value for each in qos if isinstance(each, Policy.Property)}
    own = next((each.name for each in qos if isinstance(each, Policy.EntityName)), "")
    words = (own or told.get("__ProcessName", "?"), told.get("__Pid", "?"), told.get("__Hostname", "?"))
    name, process, machine = ("".join(filter(str.isprintable, text))[:LONGEST_NAME] for text in words)
    return f"{name} (process {process} on {machine})"


def _ros_type(name: str) -> str:
    """What ROS calls a type of DDS: `sensor_msgs/msg/Image`; see `dds_type`."""
    return name.replace("::dds_::", "::").removesuffix("_").replace("::", "/")


def domain_id() -> int:
    """The network's number, ROS_DOMAIN_ID.

    Raises:
        DeploymentError: It is no number, or too large.
    """
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > LARGEST_DOMAIN:
        raise DeploymentError(f"ROS_DOMAIN_ID is '{text}'; set it to a number from 0 to {LARGEST_DOMAIN}.")
    return int(text)


@cache
def _configured_domain(number: int, network: str) -> Domain:
    """Keep a domain to a network; DDS wants that once in a process, before its first node."""
    config = THIS_MACHINE if network == LOOPBACK else ONE_INTERFACE.format(name=network)
    try:
        return Domain(number, config)
    except DDSException as error:
        raise DeploymentError(
            f"DDS domain {number} cannot be kept to the network '{network}' ({error}): another node of this "
            "process has opened it, or there is no such interface; choose another ROS_DOMAIN_ID."
        ) from error


@final
class DdsTransport(Transport):
    """A node of the DDS domain ROS_DOMAIN_ID."""

    def __init__(self, node_name: str, clock: RealClock, *, network: str) -> None:
        """Join: this machine only, or one interface, whatever CYCLONEDDS_URI says; or any, as that says.

        ROS's tools show the name where they know the version of ROS (ROS_DISTRO).

        Raises:
            DeploymentError: DDS cannot be started.
        """
        number = domain_id()
        if network != ANY:
            _configured_domain(number, network)
        try:
            qos = Qos(Policy.Userdata(b"enclave=/;"), Policy.EntityName(node_name))
            self._participant = DomainParticipant(number, qos)
        except DDSException as error:
            raise DeploymentError(
                f"DDS cannot join domain {number} ({error}); look at the network interfaces, at "
                "CYCLONEDDS_URI, and for more than 30 nodes on this machine."
            ) from error
        self._clock = clock
        self._news = WaitSet(self._participant)
        self._kept: list[Publisher | Subscription] = []  # the library takes off the network what nobody holds
        self._watchers: dict[Topic, DataReader] = {}
        self._names: dict[Topic, dict[int, str]] = {}
        self._announcement = NodeAnnouncement.of(self._participant, node_name)

    def publisher(self, topic: Topic) -> Publisher:
        """See `Transport.publisher`."""
        qos = _qos(topic, 1, NEVER_BLOCK)
        writer = DataWriter(self._participant, self._dds_topic(topic), qos)
        if self._announcement:
            self._announcement.add(writer)
        self._kept.append(publisher := _DdsPublisher(topic, writer))
        return publisher

    def subscription(self, topic: Topic, depth: int = 1, *, only_watches: bool = False) -> Subscription:
        """See `Transport.subscription`."""
        reader = self._reader(topic, depth, only_watches=only_watches)
        if not only_watches:
            self._news.attach(ReadCondition(reader, NEW))
        if self._announcement:
            self._announcement.add(reader)
        self._kept.append(subscription := _DdsSubscription(reader, depth, self._clock))
        return subscription

    def num_other_publishers(self, topic: Topic) -> int:
        """How many publishers of a topic there are besides those of this node.

        One that was killed counts for 10 s more; one that has just come is found within some 0.1 s.
        """
        return len(self._watcher(topic).get_matched_publications())

    def other_publishers(self, topic: Topic) -> dict[int, str]:
        """See `Transport.other_publishers`."""
        handles = self._watcher(topic).get_matched_publications()
        known = self._names.get(topic, {})  # what a publisher says of itself is read once
        self._names[topic] = {each: known.get(each) or self._name_of(topic, each) for each in handles}
        return {each % HANDLES: name for each, name in self._names[topic].items()}

    def _name_of(self, topic: Topic, publisher: int) -> str:
        """What a publisher's participant says of itself, in words."""
        found = self._watcher(topic).get_matched_publication_data(publisher)
        participants = {each.key: each.qos for each in self._listed(builtin.BuiltinTopicDcpsParticipant)}
        return _in_words(participants.get(found.participant_key, ()) if found else ())

    def endpoints(self) -> list[Endpoint]:
        """See `Transport.endpoints`."""
        found = []
        for kind in (builtin.BuiltinTopicDcpsPublication, builtin.BuiltinTopicDcpsSubscription):
            is_publisher = kind is builtin.BuiltinTopicDcpsPublication
            for each in self._listed(kind):
                is_other = each.participant_key != self._participant.guid
                if is_other and each.topic_name.startswith("rt/") and not _only_watches(each.qos):
                    name, type_name = each.topic_name.removeprefix("rt"), _ros_type(each.type_name)
                    found.append(Endpoint(topic=name, type=type_name, is_publisher=is_publisher))
        return found

    def _listed(self, kind: Any) -> list[Any]:
        """What DDS lists of a kind, and has not left."""
        reader = builtin.BuiltinDataReader(self._participant, kind)
        return reader.read(MOST_ENDPOINTS, ReadCondition(reader, THERE))

    def wait(self, seconds: float) -> bool:
        """See `Transport.wait`."""
        return self._news.wait(max(0, round(seconds * 1e9))) > 0

    def close(self) -> None:
        """Leave the network."""
        self._participant.__del__()  # the library has no other way while somebody holds a publisher

    def _watcher(self, topic: Topic) -> DataReader:
        """What finds the publishers of others; its messages are not taken."""
        if topic not in self._watchers:
            self._watchers[topic] = self._reader(topic, 1, Policy.IgnoreLocal.Participant, only_watches=True)
        return self._watchers[topic]

    def _reader(self, topic: Topic, depth: int, *policies: object, only_watches: bool) -> DataReader:
        """Best effort hears every publisher; latched messages must be asked for reliably."""
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
        self._takes: dict[int, bool] = {}

    def publish(self, data: bytes) -> None:
        try:
            self._writer.write(self._type(data))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:  # a reader that does not keep up
                raise DeploymentError(f"{self._topic.name} cannot be sent ({error}).") from error

    def num_subscribers(self) -> int:
        handles = self._writer.get_matched_subscriptions()
        known = self._takes  # what a subscription says of itself is read once
        self._takes = {each: known.get(each) or self._is_taken_by(each) for each in handles}
        return sum(self._takes.values())

    def _is_taken_by(self, handle: int) -> bool:
        """Whether a subscription does more than watch."""
        found = self._writer.get_matched_subscription_data(handle)
        return not (found and _only_watches(found.qos))


@final
class _DdsSubscription(Subscription):
    def __init__(self, reader: DataReader, depth: int, clock: RealClock) -> None:
        self._reader, self._clock = reader, clock
        self._most = depth + 1  # and what says that a publisher has left, which is no message
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
    """The qualities of an endpoint, which tells its message's definition: ROS 2 (from Jazzy on) compares."""
    durability = Policy.Durability.TransientLocal if topic.is_latched else Policy.Durability.Volatile
    definition = _definition(STORE.hash_rihs01(topic.type), note)
    return Qos(durability, Policy.History.KeepLast(depth), definition, *policies)


def _definition(type_hash: str, note: str = "") -> Policy.Userdata:
    """What an endpoint says of its message's definition, and of itself."""
    return Policy.Userdata(f"typehash={type_hash};{note}".encode())
