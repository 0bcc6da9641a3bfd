"""The servo against a laboratory on the wire, and its link: every layout, requests, every end."""

from dataclasses import replace

import numpy as np
import pytest
from servo_rows import HOME, LIMITS
from wire_lab import Stage, taken

from paper_robot import JOINTS
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker, MemoryTransport
from pixel2catch.ros2.profile import Profile
from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.servo.link import Command, Fault, JointTargets, LoopEnd, Mode, ServoEnd, flag_names
from pixel2catch.servo.process import ARM_PAUSE, DEPTH, JointStates, ServoSubscriptions
from pixel2catch.workcells import find_workcell

STOP_TICKS = round(STOP_TIME / LIMITS.dt)
ARM_TICKS = round(ARM_PAUSE / LIMITS.dt)


def shuffled(reading: messages.JointReading) -> messages.JointReading:
    """Return another order, with an unknown joint in front."""
    num = len(reading.names)
    other = taken(reading, np.random.default_rng(num).permutation(num).tolist())
    return replace(other, names=("gripper", *other.names), position=np.append(9.0, other.position))


def test_arm_and_hand_reach_the_target(stage: Stage):
    """With joint states in any order. Idle, nothing is sent. `twin/test_driver_doubles.py` has drivers."""
    lab = stage.lab
    lab.change = shuffled
    stage.wait(5)
    assert not any(lab.commands.values())
    stage.arm(60)
    lab.target = HOME + np.where(np.arange(len(HOME)) < 6, 0.02, 0.1)
    stage.wait(150)
    stage.servo.end()
    stage.servo.run()
    lab.step()
    assert stage.modes == [Mode.IDLE, Mode.ARMED, Mode.RAMP, Mode.RUN, Mode.STOPPED]
    assert stage.stopped_by == ("stop request",)
    target = lab.target.clip(LIMITS.joints.lower, LIMITS.joints.upper)
    np.testing.assert_allclose(lab.joint_pos, target, atol=0.01)


def test_each_driver_gets_whole_commands_at_its_rate(stage: Stage):
    """The arm in each tick, the hand in each fifth; held joints keep their angles."""
    stage.arm(50)
    stage.lab.step()
    arm, hand = stage.lab.commands.values()
    assert len(arm) >= 50
    assert len(hand) == -(-len(arm) // 5)
    for place, joint in stage.lab.profile.robots[1].held.items():
        assert {command[place] for command in hand} == {joint.angle}
    assert {len(command) for command in arm} == {6}
    np.testing.assert_allclose(arm[0], HOME[:6], atol=1e-12)


def test_held_joints_move_evenly_from_their_measured_position(stage: Stage):
    """From 0.1 rad, as measured, to 0 at 0.5 rad/s: 1 mrad in a tick, 5 from one command to the next."""
    lab, hand = stage.lab, stage.lab.profile.robots[1]
    names = [joint.name_in_state or "" for joint in hand.held.values()]
    lab.change = lambda reading: replace(
        reading,
        names=(*reading.names, *names),
        position=np.concatenate((reading.position, [0.1] * len(names))),
    )
    stage.arm(120)
    sent = np.array(lab.commands["hand"])[:, [*hand.held]]
    np.testing.assert_allclose(sent[0], 0.1 - 0.001, atol=1e-12)
    np.testing.assert_allclose(np.diff(sent, axis=0)[:19], -0.005, atol=1e-12)
    np.testing.assert_allclose(sent[20:], 0.0, atol=1e-12)


def test_older_messages_do_not_move_held_joints(stage: Stage):
    hand, node = stage.lab.profile.robots[1], Broker().node(stage.lab.clock)
    joints, driver = JointStates(node, stage.lab.profile, len(HOME)), node.publisher(hand.state_topic)
    ours = tuple(joint.name_in_state or "" for joint in hand.joints.values())
    theirs = tuple(joint.name_in_state or "" for joint in hand.held.values())
    for stamp, angle in ((10.0, 0.1), (9.99, 0.7), (10.0, 0.8)):
        position = np.repeat((0.0, angle), (len(ours), len(theirs)))
        driver.publish(messages.joint_state(ours + theirs, position, stamp))
        joints.read()
        np.testing.assert_allclose(joints.held[1], 0.1)


def test_a_robot_of_unknown_status_is_not_armed(stage: Stage):
    assert stage.lab.profile.status.robot_mode
    stage.lab.silent.add(stage.lab.profile.status.robot_mode.name)
    stage.wait(11)
    stage.lab.request_arm()
    stage.wait(5)
    refused = {tuple(flag_names(Fault, each.refused)) for each in stage.lab.ticks}
    assert refused == {(), ("status unknown",)}
    assert stage.modes == [Mode.IDLE]


@pytest.mark.parametrize("arm", [0, 1])
def test_the_status_of_both_arms_is_watched(arm: int):
    profile, broker, clock = Profile.load("two_ur5e_allegro"), Broker(), StepClock(lambda _: None)
    limits = ServoLimits.of(find_workcell(profile.workcell))
    watched, driver = ServoSubscriptions(broker.node(clock), profile, limits, ()), broker.node(clock)
    topics = [{name: driver.publisher(topic) for name, topic in each.items()} for each in profile.all_status]
    none = JointTargets.none(limits.num_joints)
    for number, mode, speed in ((0, 1, 100.0), (1, 1, 100.0), (arm, 3, 50.0)):
        topics[number]["safety_mode"].publish(messages.safety_mode(mode))
        topics[number]["speed_scaling"].publish(messages.number(speed))
        watched.read(clock.now())
        inputs = watched.inputs(clock.now(), none)
        assert (inputs.is_safe[0], inputs.speed_scaling[0]) == (mode == 1, speed / 100.0)


def test_the_end_of_the_control_loop_stops_the_robot_and_ends_the_servo(stage: Stage):
    lab = stage.lab
    stage.arm(60)
    lab.target = HOME + 0.1
    stage.wait(30)
    lab.silent.add("control loop")
    stage.loop.close()
    stage.servo.run()
    changes = np.abs(np.diff(lab.commands["arm"], axis=0)).max(axis=-1)
    assert len(changes) >= STOP_TICKS
    assert changes.max() > 1e-4
    assert not changes[-3:].any()


def test_an_unexpected_error_is_raised_after_the_robot_was_stopped(stage: Stage, monkeypatch):
    def fail(*_: object, **__: object) -> int:
        raise RuntimeError("no network")

    stage.arm()
    monkeypatch.setattr(MemoryTransport, "num_other_publishers", fail)
    with pytest.raises(RuntimeError, match="no network"):
        stage.servo.run()
    assert stage.modes[-1] == Mode.STOPPED
    assert len(stage.lab.commands["arm"]) > STOP_TICKS


def test_a_dry_run_sends_nothing_and_runs(ends: tuple[LoopEnd, ServoEnd]):
    """The robot stands still; control loop and recordings receive the commands."""
    stage = Stage(Profile.load("ur5e_allegro_v4"), ends, is_dry_run=True)
    stage.arm(60)
    stage.lab.target = HOME + 0.2
    assert stage.wait(60) == Mode.RUN
    assert not any(stage.lab.commands.values())
    watcher = stage.broker.node(stage.clock)
    assert not any(watcher.num_other_publishers(part.command_topic) for part in stage.lab.profile.robots)
    assert stage.lab.ticks[-1].joint_pos_command[0] > HOME[0] + 0.1


def test_a_request_to_stop_counts_among_many_other_messages(stage: Stage):
    """Another program sends many messages without a request in one tick; lost ones count as requests."""
    stop = stage.lab.profile.operator.stop
    other = stage.broker.node(stage.clock).publisher(stop)
    stage.arm(80)
    stage.lab.send(stop, messages.boolean(True))
    for _ in range(DEPTH):
        other.publish(messages.boolean(False))
    assert stage.wait(2) == Mode.STOPPED
    other.publish(messages.boolean(False))
    assert stage.wait(STOP_TICKS) == Mode.STOPPED
    assert stage.stopped_by == ("stop request",)


def test_an_endless_request_to_arm_counts_once(stage: Stage):
    """500 requests a second; after a stop and a new press of the switch, the robot stays stopped."""
    lab = stage.lab
    stage.arm(80)
    for tick in range(STOP_TICKS + 2 * ARM_TICKS):
        lab.request_arm()
        if tick == 10:
            lab.send(lab.profile.operator.stop, messages.boolean(True))
        lab.is_held = not 20 < tick < 60
        stage.wait(1)
    assert stage.modes == [Mode.IDLE, Mode.ARMED, Mode.RAMP, Mode.RUN, Mode.STOPPED]


def test_an_old_request_to_arm_does_not_count(stage: Stage):
    topic = stage.lab.profile.operator.arm
    (requests,) = [each for each in stage.node.queues if each.topic == topic]
    stage.wait(11)
    requests.put(messages.boolean(True), age=0.3)
    assert stage.wait(20) == Mode.IDLE
    requests.put(messages.boolean(True))
    assert stage.wait(5) != Mode.IDLE


NUMBERS = np.linspace(-1.0, 1.0, len(JOINTS))
TARGETS = JointTargets.of(np.array([1.0, 0.5, 0.4, False, True, False, *NUMBERS]))
COMMAND = Command.of(np.array([1.0, 4e-4, 0.99, 0.98, 3, 4, 1 << 15, 6, 7, *(np.nan * NUMBERS), *NUMBERS]))


def test_targets_and_commands_arrive_unchanged(ends: tuple[LoopEnd, ServoEnd]):
    loop, servo = ends
    assert (COMMAND.found, TARGETS.is_stop_requested, TARGETS.box_stamp) == (1 << 15, True, 0.4)
    loop.send(TARGETS)
    servo.send(COMMAND)
    (ordered,), (decided,) = servo.receive(), loop.receive()
    for sent, received in ((TARGETS, ordered), (COMMAND, decided)):
        for name, value in vars(sent).items():
            np.testing.assert_array_equal(getattr(received, name), value)
    assert not servo.receive()
    assert not servo.is_closed


def test_packets_that_do_not_fit_are_dropped_and_counted(ends: tuple[LoopEnd, ServoEnd]):
    """At least 0.3 s of ticks fit; newer packets are lost."""
    loop, servo = ends
    for tick in range(5000):
        servo.send(replace(COMMAND, time=float(tick)))
    received = loop.receive()
    assert [each.time for each in received] == [float(tick) for tick in range(len(received))]
    assert len(received) > 150
    assert servo.num_dropped == 5000 - len(received)
    servo.send(replace(COMMAND, time=9.0))
    assert loop.receive()[0].time == 9.0


def test_packets_from_before_the_end_are_received(ends: tuple[LoopEnd, ServoEnd]):
    loop, servo = ends
    loop.send(TARGETS)
    loop.close()
    assert len(servo.receive()) == 1
    assert servo.is_closed
    servo.send(COMMAND)
    assert servo.num_dropped == 1
