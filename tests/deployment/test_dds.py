"""DDS: names, types and domains as ROS 2 expects them, and who joins; `test_transports` has the rest."""

import multiprocessing
import os
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import pytest
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic as DdsTopic

from domains import PATIENCE, own_domain, until
from pixel2catch.cli.deploy import Deploy
from pixel2catch.cli.link import Link
from pixel2catch.cli.operate import Operate
from pixel2catch.cli.record import Record
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.dds import THIS_MACHINE, dds_type
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import ANY, LOOPBACK, ROS, RealClock, Topic, make_transport

STATES = Topic(name="/joint_states", type=messages.JOINT_STATE)
MODE = Topic(name="/io/safety_mode", type=messages.SAFETY_MODE, is_latched=True)


@pytest.fixture
def make(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with ExitStack() as stack:
        yield lambda name: stack.enter_context(make_transport(name, LOOPBACK, RealClock()))


def foreign_writer(*policies):
    """Another program, which leaves without a reference, and its writer of joint states."""
    program = DomainParticipant(int(own_domain()), Qos(*policies))
    topic = DdsTopic(program, "rt/joint_states", dds_type(STATES.type))
    return program, DataWriter(program, topic, Qos(Policy.Reliability.Reliable(0)))


def test_a_publisher_is_named_by_node_process_and_machine(make):
    node, _stranger = make("node"), foreign_writer(Policy.EntityName("stranger\n" + 90 * "!"))
    make("driver").publisher(STATES)
    until(lambda: len(node.other_publishers(STATES)) == 2)
    found = {*node.other_publishers(STATES).values()}
    where = f"(process {os.getpid()} on {socket.gethostname()})"
    assert found == {f"driver {where}", f"stranger{52 * '!'} {where}"}


def test_publishers_have_the_names_types_and_hashes_of_ros_2(make):
    node = make("node")
    for topic in (STATES, MODE):
        node.publisher(topic)
    participant = DomainParticipant(int(own_domain()))
    reader = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    found = {endpoint.topic_name: endpoint for endpoint in reader.take(N=100)}
    states, mode = found["rt/joint_states"], found["rt/io/safety_mode"]
    assert states.type_name == "sensor_msgs::msg::dds_::JointState_"
    assert mode.type_name == "ur_dashboard_msgs::msg::dds_::SafetyMode_"
    # The hash is that of the message's definition in ROS 2 Jazzy: `ros2 topic info --verbose`.
    digest = b"a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
    assert states.qos[Policy.Userdata].data == b"typehash=RIHS01_" + digest + b";"
    assert states.qos[Policy.Durability] == Policy.Durability.Volatile
    assert mode.qos[Policy.Durability] == Policy.Durability.TransientLocal
    assert isinstance(states.qos[Policy.Reliability], Policy.Reliability.Reliable)


def test_the_arrival_does_not_depend_on_the_clock_of_the_sender(make):
    node, clock = make("node"), RealClock()
    subscription, (_stranger, writer), before = node.subscription(STATES), foreign_writer(), clock.now()
    subscription.take()
    sent = round(1e9 * (clock.stamp() + 3600.0))
    writer.write(dds_type(STATES.type)(messages.joint_state([], [], 0.0)), sent)
    assert node.wait(PATIENCE)
    (message,) = subscription.take()
    assert before <= message.arrival <= clock.now()


def test_a_domain_that_does_not_exist_is_refused(make, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    with pytest.raises(DeploymentError, match=r"ROS_DOMAIN_ID is .* set it to a number from 0 to 232"):
        make("node")


def test_rclpy_needs_a_sourced_ros_2():
    if find_spec("rclpy"):
        pytest.skip("ROS 2 is sourced")
    with pytest.raises(DeploymentError, match=r"source ROS 2 .* or another --network"):
        make_transport("node", ROS, RealClock())


def send_latched(is_sent) -> None:
    with make_transport("driver", ANY, RealClock()) as node:
        node.publisher(MODE).publish(messages.safety_mode(1))
        is_sent.set()
        time.sleep(4.0 * PATIENCE)


def test_a_rehearsal_receives_nothing_of_a_robots_driver_on_this_machine(make, monkeypatch):
    """The driver's node is reachable, but has no tag; with the tag, its message arrives."""
    tag, context = "<Tag>pixel2catch</Tag>", multiprocessing.get_context("spawn")
    assert tag in THIS_MACHINE
    monkeypatch.setenv("CYCLONEDDS_URI", THIS_MACHINE)
    node = make("node")
    node.subscription(MODE)
    for configuration, is_received in ((THIS_MACHINE.replace(tag, ""), False), (THIS_MACHINE, True)):
        monkeypatch.setenv("CYCLONEDDS_URI", configuration)
        process = context.Process(target=send_latched, args=[is_sent := context.Event()], daemon=True)
        process.start()
        try:
            assert is_sent.wait(PATIENCE)
            assert node.wait(PATIENCE if is_received else 0.5) == is_received
        finally:
            process.kill()


def test_a_node_and_a_profile_need_no_simulator():
    """The servo's process starts fast: neither torch, MuJoCo nor OpenCV is loaded for a node."""
    script = "import sys, pixel2catch.ros2.dds, pixel2catch.ros2.profile; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert not {"torch", "mujoco", "cv2"} & set(loaded.split())


def test_commands_join_this_machine_only_by_default_where_no_identified_dynamics_are_needed():
    """If a robot may be connected, commands are no faster than its joints."""
    record = Record(trajectory=Path("a"), out=Path("b"))
    links = (Deploy().link, record.link, Operate(device=Path("a")).network)
    assert {link.network for link in links} == {LOOPBACK}
    profile = Profile.load("ur5e_allegro_v4")
    twin = Link().limits(profile).joints
    for link in (Link(network=ANY), Link(network=ROS)):
        assert not link.is_twin
        assert (link.limits(profile).joints.speed < twin.speed).all()


def test_time_passes_while_the_machine_is_suspended():
    """In a namespace of Linux whose clock is 1,000 s ahead."""
    script = "from pixel2catch.ros2.transport import RealClock; print(RealClock(0.5).now())"
    ahead = ["unshare", "--time", "--boottime", "1000", sys.executable, "-c", script]
    before = RealClock(0.5).now()
    found = subprocess.run(ahead, capture_output=True, text=True)
    if found.returncode:
        pytest.skip(f"no namespaces of time here: {found.stderr}")
    assert 500.0 <= float(found.stdout) - before < 500.0 + PATIENCE
