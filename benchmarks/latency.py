"""How long it takes from an image to the command on the wire, and where the time goes, in real time.

`pixel2catch deploy` with its servo process, in a dry run, hears over DDS on this machine what was recorded of
a deployment: images at 30 Hz, joint states at 500 Hz, the drivers' status and the operator. All of it is in
memory before, with new stamps; nothing is drawn meanwhile. An image is commanded when the servo's tick begins
that takes its command; the tick sends it.

    pixel2catch rehearse --lockstep --throws 3 --record recording
    python benchmarks/latency.py recording --passes 4
"""

import argparse
import json
import os
import resource
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pixel2catch.deployment.operator import newest
from pixel2catch.deployment.replay import played_topics
from pixel2catch.ros2 import messages
from pixel2catch.ros2.bags import opened_bag
from pixel2catch.ros2.messages import COMPRESSED_IMAGE, SUFFIX
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Topic, Transport, make_transport
from pixel2catch.servo.link import SERVO_PRIORITY, set_real_time

STAMPED = (messages.IMAGE, messages.JOINT_STATE)
PAUSE = 1.0
START_TIME = 120.0
POLL = 0.02

Played = list[tuple[float, Topic, bytearray]]


def played(recording: Path, topics: set[Topic]) -> Played:
    """What is played: time since the first message [s], topic and message, in which images are raw."""
    by_name = {topic.name: topic for topic in topics}
    entries: Played = []
    with opened_bag(recording) as reader:
        for connection, nanoseconds, data in reader.messages():
            name = connection.topic
            if connection.msgtype == COMPRESSED_IMAGE:
                name, data = name.removesuffix(SUFFIX), messages.uncompress(bytes(data))
            if topic := by_name.get(name):
                entries.append((1e-9 * (nanoseconds - reader.start_time), topic, bytearray(data)))
        start = 1e-9 * reader.start_time
    for _, topic, data in entries:  # their stamps count from the first message, too
        if topic.type in STAMPED:
            seconds, fraction = struct.unpack_from("<iI", data, 4)
            struct.pack_into("<d", data, 4, seconds + 1e-9 * fraction - start)
    return entries


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


@contextmanager
def deployment(args: argparse.Namespace, out: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`deploy` as a process; what it prints goes to a file."""
    command = [sys.executable, "-m", "pixel2catch", "deploy", "--dry-run", "--json"]
    command += ["--clock", f"{args.clock:g}", *(["--record", str(args.record)] if args.record else [])]
    with open(out, "wb") as file, subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT) as process:
        try:
            yield process
        finally:
            process.terminate()
            process.wait(START_TIME)


def wait_for(node: Transport, profile: Profile, process: subprocess.Popen[bytes]) -> None:
    """Wait until the deployment and its servo are there."""
    statuses, end = node.subscription(profile.operator.status), time.monotonic() + START_TIME
    while newest(statuses.take(), {}).get("mode") != "idle":
        if process.poll() is not None or time.monotonic() > end:
            raise SystemExit("the deployment did not start")
        node.wait(POLL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recording", type=Path, help="what `rehearse --record` or `deploy --record` wrote")
    parser.add_argument("--passes", type=int, default=3, help="how often it is played")
    parser.add_argument("--clock", type=float, default=1.0, help="seconds in a real one")
    parser.add_argument("--record", type=Path, help="new folder: have the deployment record, too")
    args = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", "92")
    profile, clock = Profile.load("ur5e_allegro_v4"), RealClock(args.clock)
    entries, load = played(args.recording, played_topics(profile)), os.getloadavg()[0]
    images = ((moment, data) for moment, topic, data in entries if topic.type == messages.IMAGE)
    ages = [moment - struct.unpack_from("<d", data, 4)[0] for moment, data in images]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "deploy.txt"
        with make_transport("replayer", LOOPBACK, clock) as node:
            with deployment(args, out) as process:
                wait_for(node, profile, process)
                set_real_time(SERVO_PRIORITY)  # as the drivers that it stands for
                begin = time.monotonic()
                cpu = {"replayer": play(entries, node, clock, args.passes)}
                seconds = time.monotonic() - begin
            used = resource.getrusage(resource.RUSAGE_CHILDREN)
            cpu["deployment with its start"] = (used.ru_utime + used.ru_stime) / seconds
        said = [line for line in out.read_text().splitlines() if line.startswith('{"summary"')]
        if not said:
            raise SystemExit(out.read_text()[-2000:])
    report = {
        "sent_ms": 1e3 * statistics.median(ages),
        "load": [load, os.getloadavg()[0]],
        "cpu": cpu,
        "deploy": json.loads(said[0])["summary"],
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
