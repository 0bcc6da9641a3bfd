"""How long a tick of the servo takes, decoding and encoding included; network and waiting are not.

python benchmarks/servo_tick.py RECORDING

Plays what `rehearse --record` or `deploy --record` wrote to a servo in memory, tick by tick at the times of
the recorded ones. The time of the processor does not count what other programs take meanwhile.
"""

import gc
import os
from pathlib import Path
from time import perf_counter, thread_time

import numpy as np
import tyro
from tyro.conf import Positional

from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.recorder import SERVO, TARGETS
from pixel2catch.deployment.replay import played, played_topics
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Topic
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import Command, JointTargets, link
from pixel2catch.servo.process import Servo, ServoSetup
from pixel2catch.workcells import find_workcell

AFTER = 50e-6  # s; what was recorded so little after a tick, of several messages at once, was heard in it
WARM_UP = 300  # ticks that do not count


def main(recording: Positional[Path]) -> None:
    profile, clock, broker = Profile.load("ur5e_allegro_v4"), StepClock(lambda _: None), Broker()
    node = broker.node(clock)
    drivers = [node.subscription(part.command_topic, 16) for part in profile.robots]
    publishers = {topic: node.publisher(topic) for topic in played_topics(profile)}
    loop, end = link()
    setup = ServoSetup(profile=profile, limits=ServoLimits.of(find_workcell(profile.workcell)))
    servo = Servo(end, broker.node(clock), setup, clock)
    entries = list[tuple[float, Topic, bytes]]()
    for time, topic, data in played(recording, {*publishers, TARGETS, SERVO}):
        entries.append((time + AFTER if topic == SERVO else time, topic, data))
    times = list[tuple[float, float]]()
    gc.disable()
    for moment, topic, data in sorted(entries, key=lambda entry: entry[0]):
        clock.time = moment
        if topic in publishers:
            publishers[topic].publish(data)
        elif topic == TARGETS:
            row = messages.read_float_array(data)
            loop.send(JointTargets.of(row))
        else:
            clock.time = Command.of(messages.read_float_array(data)).time
            begun, worked = perf_counter(), thread_time()
            servo.tick()
            times.append((perf_counter() - begun, thread_time() - worked))
            for heard in (loop.receive, *(driver.take for driver in drivers)):
                heard()
    print(f"{len(times) - WARM_UP} ticks, load {os.getloadavg()[0]:.1f} [ms]:")
    for name, column in zip(("passed", "of the processor"), 1e3 * np.array(times[WARM_UP:]).T, strict=True):
        shown = np.percentile(column, (0, 10, 50, 90, 99))
        print(
            f"{name:17} min {{:.3f}}, p10 {{:.3f}}, p50 {{:.3f}}, p90 {{:.3f}}, p99 {{:.3f}}".format(*shown)
        )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
