"""A process as a node with a name, as rmw publishes it on `ros_discovery_info`. Needs cyclonedds."""

import os
from typing import Any

import numpy as np
from cyclonedds.core import Entity
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from rosbags.typesys import Stores, get_typestore

from pixel2catch.deployment.dds_types import dds_type

MESSAGE = "rmw_dds_common/msg/ParticipantEntitiesInfo"

LATCHED = Qos(
    Policy.Durability.TransientLocal,
    Policy.Reliability.Reliable(max_blocking_time=0),
    Policy.History.KeepLast(1),
)


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
        topic = Topic(participant, "ros_discovery_info", self._type)
        self._writer = DataWriter(participant, topic, LATCHED)
        self._announce()

    @classmethod
    def of(cls, participant: DomainParticipant, node_name: str) -> "NodeAnnouncement | None":
        """Announce a node to the ROS 2 of ROS_DISTRO; None, and nothing sent, if that is unknown."""
        try:
            store = get_typestore(Stores(f"ros2_{os.environ.get('ROS_DISTRO', '')}"))
        except ValueError:
            return None
        return cls(participant, node_name, store) if MESSAGE in store.types else None

    def add_reader(self, reader: Entity) -> None:
        """Announce a subscription of the node."""
        self._readers.append(self._gid(reader))
        self._announce()

    def add_writer(self, writer: Entity) -> None:
        """Announce a publisher of the node."""
        self._writers.append(self._gid(writer))
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
