"""How long it takes from an image to the command on the wire, and where the time goes, in real time.

`pixel2catch deploy` with its servo process, in a dry run, hears over DDS on this machine what was recorded of
a deployment: images at 30 Hz, joint states at 500 Hz, the drivers' status and the operator. All of it is in
memory before, with new stamps; nothing is drawn meanwhile. An image is commanded when the servo's tick begins
that takes its command; the tick sends it.

    pixel2catch rehearse --lockstep --throws 3 --record recording
    python benchmarks/latency.py recording --passes 4

`--passes` says how often it is played, `--record` in which new folder the deployment records, too.
"""

import json
import os
import resource
import statistics
import struct
import tempfile
import time
from pathlib import Path
from subprocess import Popen

import tyro
from tyro.conf import Positional

from pixel2catch.deployment.operator import newest
from pixel2catch.deployment.replay import played, played_topics
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Topic, Transport, make_transport
from pixel2catch.servo.link import SERVO_PRIORITY, set_real_time
from pixel2catch.twin.rehearsal import printed_summary, running_command

STAMPED = (messages.IMAGE, messages.JOINT_STATE)
PAUSE = 1.0
START_TIME = 120.0
POLL = 0.02

Played = list[tuple[float, Topic, bytearray]]


def read(recording: Path, topics: set[Topic]) -> Played:
    """What is played: time since the first message [s], topic and message, in which images are raw."""
    entries = [(time, topic, bytearray(data)) for time, topic, data in played(recording, topics)]
    start = entries[0][0]
    for _, topic, data in entries:  # their stamps count from the first message, too
        if topic.type in STAMPED:
            seconds, fraction = struct.unpack_from("<iI", data, 4)
            struct.pack_into("<d", data, 4, seconds + 1e-9 * fraction - start)
    return [(time - start, topic, data) for time, topic, data in entries]


def play(entries: Played, node: Transport, clock: RealClock, passes: int) -> float:
    """Play it all so many times; return the share of a core that this took."""
    publishers = {topic: node.publisher(topic) for topic in {entry[1] for entry in entries}}
    cpu, start = time.process_time(), clock.now()
    for _ in range(passes):
        begin, stamp = clock.now(), clock.stamp()
        for moment, topic, data in entries:
            clock.sleep_until(begin + moment)
            message = data
            if topic.type in STAMPED:
                nanoseconds = round(1e9 * (stamp + struct.unpack_from("<d", data, 4)[0]))
                message = data.copy()
                struct.pack_into("<iI", message, 4, nanoseconds // 10**9, nanoseconds % 10**9)
            publishers[topic].publish(bytes(message))
        clock.sleep_until(clock.now() + PAUSE)
    return (time.process_time() - cpu) / (clock.now() - start)


def wait_for(node: Transport, profile: Profile, process: Popen[bytes]) -> None:
    """Wait until the deployment and its servo are there."""
    statuses, end = node.subscription(profile.operator.status), time.monotonic() + START_TIME
    while newest(statuses.take(), {}).get("mode") != "idle":
        if process.poll() is not None or time.monotonic() > end:
            raise SystemExit("the deployment did not start")
        node.wait(POLL)


def main(
    recording: Positional[Path], passes: int = 3, clock: float = 1.0, record: Path | None = None
) -> None:
    os.environ.setdefault("ROS_DOMAIN_ID", "92")
    profile, played_clock = Profile.load("ur5e_allegro_v4"), RealClock(clock)
    entries, load = read(recording, played_topics(profile)), os.getloadavg()[0]
    images = ((moment, data) for moment, topic, data in entries if topic.type == messages.IMAGE)
    ages = [moment - struct.unpack_from("<d", data, 4)[0] for moment, data in images]
    options = ["--dry-run", "--json", "--clock", f"{clock:g}", *(["--record", str(record)] if record else [])]
    with tempfile.TemporaryDirectory() as folder:
        with make_transport("replayer", LOOPBACK, played_clock) as node:
            with running_command(Path(folder), "deploy", *options) as process:
                wait_for(node, profile, process)
                set_real_time(SERVO_PRIORITY)  # as the drivers that it stands for
                begin = time.monotonic()
                cpu = {"replayer": play(entries, node, played_clock, passes)}
                seconds = time.monotonic() - begin
            used = resource.getrusage(resource.RUSAGE_CHILDREN)
            cpu["deployment with its start"] = (used.ru_utime + used.ru_stime) / seconds
        summary = printed_summary(Path(folder, "deploy.txt"))
    report = {
        "sent_ms": 1e3 * statistics.median(ages),
        "load": [load, os.getloadavg()[0]],
        "cpu": cpu,
        "deploy": summary,
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
