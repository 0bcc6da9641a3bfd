"""Latency, losses and CPU time of the DDS transport between two processes of this machine.

One sends images (640 x 480) at 30 Hz and joint states at 500 Hz;
the other answers every image with a command.

    python benchmarks/transport_latency.py --seconds 10
"""

import argparse
import json
import multiprocessing
import os
import time
from pathlib import Path

import numpy as np

from pixel2catch.ros2 import messages
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Topic, make_transport
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

IMAGES = Topic(name="/benchmark/image", type=messages.IMAGE)
STATES = Topic(name="/benchmark/joint_states", type=messages.JOINT_STATE)
COMMANDS = Topic(name="/benchmark/command", type=messages.FLOAT_ARRAY)
SETTLE = 1.0
NAMES = UR5E_ALLEGRO.joint_names


def lab(seconds: float, results) -> None:
    """Send on a schedule; measure how long the command to an image takes."""
    clock, answers = RealClock(), []
    pixels = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    with make_transport("lab", LOOPBACK, clock) as node:
        images, states = node.publisher(IMAGES), node.publisher(STATES)
        commands = node.subscription(COMMANDS, depth=10)
        time.sleep(SETTLE)
        cpu, begin, num_images = time.process_time(), clock.now(), 0
        for tick in range(round(500 * seconds)):
            clock.sleep_until(begin + tick / 500)
            states.publish(messages.joint_state(NAMES, np.zeros(len(NAMES)), clock.now()))
            if tick * 30 // 500 >= num_images:
                images.publish(messages.image(pixels, clock.now()))
                num_images += 1
            for message in commands.take():
                answers.append(clock.now() - messages.read_float_array(message.data)[0])
        share = (time.process_time() - cpu) / (clock.now() - begin)
        results.put(
            ("lab", {"image_to_command_ms": milliseconds(answers), "images": num_images, "cpu": share})
        )


def pipeline(seconds: float, results) -> None:
    """Wait for messages; answer images at once."""
    clock, ages = RealClock(), {"image_ms": [], "joint_state_ms": []}
    with make_transport("brain", LOOPBACK, clock) as node:
        images, states = node.subscription(IMAGES, depth=10), node.subscription(STATES, depth=100)
        commands = node.publisher(COMMANDS)
        cpu, begin = time.process_time(), clock.now()
        while clock.now() - begin < seconds + 3 * SETTLE:
            node.wait(0.1)
            for message in images.take():
                reading = messages.read_image(message.data)
                ages["image_ms"].append(clock.now() - reading.stamp)
                commands.publish(messages.float_array([reading.stamp]))
            for message in states.take():
                ages["joint_state_ms"].append(clock.now() - messages.read_joint_state(message.data).stamp)
        share = (time.process_time() - cpu) / (clock.now() - begin)
    counts = {f"{name.removesuffix('_ms')}s": len(values) for name, values in ages.items()}
    figures = {name: milliseconds(values) for name, values in ages.items()}
    results.put(("brain", {"received": counts, **figures, "cpu": share}))


def milliseconds(ages: list[float]) -> dict[str, float]:
    return {name: 1e3 * float(np.percentile(ages, q)) for name, q in (("p50", 50), ("p99", 99), ("max", 100))}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to send")
    parser.add_argument("--json", type=Path, help="file for the figures")
    args = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", "91")
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    processes = [context.Process(target=side, args=(args.seconds, results)) for side in (pipeline, lab)]
    for process in processes:
        process.start()
    report = dict(sorted(results.get(timeout=args.seconds + 60.0) for _ in processes))
    report["lab"]["joint_states"] = round(500 * args.seconds)
    text = json.dumps(report, indent=2)
    print(text)
    if args.json:
        args.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
