"""What DDS shows to others on the network, where ROS 2 looks; `test_transports` has the rest."""

import multiprocessing
import os
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from importlib.util import find_spec

import numpy as np
import pytest
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic as DdsTopic
from networks import dds_nodes

from domains import PATIENCE, own_domain
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.dds import THIS_MACHINE, dds_type
from pixel2catch.ros2.transport import ANY, LOOPBACK, RealClock, Topic, make_transport

STATES = Topic(name="/joint_states", type=messages.JOINT_STATE)
MODE = Topic(name="/io/safety_mode", type=messages.SAFETY_MODE, is_latched=True)


@pytest.fixture
def make(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with ExitStack() as stack:
        yield dds_nodes(stack)


def announced():
    """All publishers of the domain, by topic, as any DDS program sees them."""
    participant = DomainParticipant(int(own_domain()))
    reader = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    return {endpoint.topic_name: endpoint for endpoint in reader.take(N=100)}


def test_a_publisher_is_known_by_its_node_process_and_machine(make):
    node, program = (
        make("node"),
        DomainParticipant(int(own_domain()), Qos(Policy.EntityName("stranger\n" + 90 * "!"))),
    )
    writer = DataWriter(program, DdsTopic(program, "rt/joint_states", dds_type(STATES.type)))
    make("driver").publisher(STATES)
    end = time.monotonic() + PATIENCE
    while len(found := {*node.other_publishers(STATES).values()}) < 2:
        assert time.monotonic() < end
    where = f"(process {os.getpid()} on {socket.gethostname()})"
    assert found == {f"driver {where}", f"stranger{52 * '!'} {where}"}
    assert writer is not None


def test_publishers_have_the_names_types_and_hashes_of_ros_2(make):
    node = make("node")
    for topic in (STATES, MODE):
        node.publisher(topic)
    found = announced()
    states, mode = found["rt/joint_states"], found["rt/io/safety_mode"]
    assert states.type_name == "sensor_msgs::msg::dds_::JointState_"
    assert mode.type_name == "ur_dashboard_msgs::msg::dds_::SafetyMode_"
    # The hash is that of the message's definition in ROS 2 Jazzy: `ros2 topic info --verbose`.
    digest = b"a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
    assert states.qos[Policy.Userdata].data == b"typehash=RIHS01_" + digest + b";"
    assert states.qos[Policy.Durability] == Policy.Durability.Volatile
    assert mode.qos[Policy.Durability] == Policy.Durability.TransientLocal
    assert isinstance(states.qos[Policy.Reliability], Policy.Reliability.Reliable)


@pytest.mark.parametrize("hours", [-1.0, 1.0])
def test_a_sender_with_a_wrong_clock_cannot_make_messages_older_or_newer_than_they_are(make, hours):
    node, clock = make("node"), RealClock()
    subscription = node.subscription(STATES)
    participant = DomainParticipant(int(own_domain()))
    kind = dds_type(STATES.type)
    qos = Qos(Policy.Reliability.Reliable(0))
    writer = DataWriter(participant, DdsTopic(participant, "rt/joint_states", kind), qos)
    before = clock.now()
    subscription.take()
    sent = round(1e9 * (clock.stamp() + 3600.0 * hours))
    writer.write(kind(messages.joint_state([], [], 0.0)), sent)
    assert node.wait(PATIENCE)
    (message,) = subscription.take()
    assert before <= message.arrival <= clock.now()


@pytest.mark.parametrize("text", ["233", "-1", "one"])
def test_a_domain_that_does_not_exist_is_refused(make, monkeypatch, text):
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    with pytest.raises(DeploymentError, match=r"ROS_DOMAIN_ID is .* set it to a number from 0 to 232"):
        make("node")


def test_where_ros_2_is_not_sourced_its_transport_says_what_to_do():
    if find_spec("rclpy"):
        pytest.skip("ROS 2 is sourced")
    with pytest.raises(DeploymentError, match=r"source ROS 2 .* or take the transport dds"):
        make_transport("ros", "node", LOOPBACK, RealClock())


def echo() -> None:
    """The other process: turn every joint state's positions over, until it gets one without joints."""
    with make_transport("dds", "echo", LOOPBACK, RealClock()) as node:
        states, answers = node.subscription(STATES, depth=10), node.publisher(ECHO)
        node.publisher(MODE).publish(messages.safety_mode(1))
        while node.wait(PATIENCE):
            for message in states.take():
                reading = messages.read_joint_state(message.data)
                if not reading.names:
                    return
                answers.publish(messages.float_array(-reading.position))


ECHO = Topic(name="/echo", type=messages.FLOAT_ARRAY)


def test_two_processes_talk_over_the_loopback_interface(make):
    node = make("node")
    mode, answers, states = (
        node.subscription(MODE),
        node.subscription(ECHO, depth=100),
        node.publisher(STATES),
    )
    process = multiprocessing.get_context("spawn").Process(target=echo)
    process.start()
    try:
        assert node.wait(PATIENCE), "the other process has come: its latched message is here"
        assert [messages.read_safety_mode(message.data) for message in mode.take()] == [1]
        for value in range(20):
            states.publish(messages.joint_state(["a", "b"], [value, 1.0], 0.0))
            assert node.wait(PATIENCE)
            (answer,) = answers.take()
            np.testing.assert_array_equal(messages.read_float_array(answer.data), [-value, -1.0])
        states.publish(messages.joint_state([], [], 0.0))
        process.join(PATIENCE)
        assert process.exitcode == 0
    finally:
        process.kill()


def shout(is_sent) -> None:
    """Another process, with the configuration of CYCLONEDDS_URI: send a latched message and stay."""
    with make_transport("dds", "driver", ANY, RealClock()) as node:
        node.publisher(MODE).publish(messages.safety_mode(1))
        is_sent.set()
        time.sleep(4.0 * PATIENCE)


@pytest.mark.parametrize("is_of_the_rehearsal", [True, False])
def test_a_rehearsal_does_not_hear_a_robots_driver_on_this_machine(make, monkeypatch, is_of_the_rehearsal):
    """The driver's node is reachable, but has no tag."""
    tag = "<Tag>pixel2catch</Tag>"
    assert tag in THIS_MACHINE
    monkeypatch.setenv(
        "CYCLONEDDS_URI", THIS_MACHINE if is_of_the_rehearsal else THIS_MACHINE.replace(tag, "")
    )
    node = make("node")
    node.subscription(MODE)
    context = multiprocessing.get_context("spawn")
    is_sent = context.Event()
    process = context.Process(target=shout, args=[is_sent], daemon=True)
    process.start()
    try:
        assert is_sent.wait(PATIENCE)
        assert node.wait(PATIENCE if is_of_the_rehearsal else 0.5) == is_of_the_rehearsal
    finally:
        process.kill()


def test_a_node_and_a_profile_need_no_simulator():
    """The servo's process starts fast: neither torch, MuJoCo nor OpenCV is loaded for a node."""
    script = "import sys, pixel2catch.ros2.dds, pixel2catch.ros2.profile; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert not {"torch", "mujoco", "cv2"} & set(loaded.split())
