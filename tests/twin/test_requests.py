"""Requests to the twin, changed at random: heeded, or refused with a reason; the twin goes on."""

import json
import random
from typing import Any

from twin_bench import Bench

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.twin.lab_node import COMMAND

REQUESTS = ({"do": "prepare", "seed": 3}, {"do": "throw"}, {"do": "protective_stop"}, {"do": "resume"})
STRANGE = (
    None,
    True,
    -1,
    2**63,
    2**70,
    1e308,
    float("nan"),
    "",
    "\0",
    "prepare",
    [],
    {},
    [[]],
    "\ud800",
    3.5,
)
NUM_CHANGES = 120


def changed(random_: random.Random) -> bytes:
    """A request with other values, without a key, with a strange one, cut off, or with other bytes."""
    request: dict[str, Any] = dict(random_.choice(REQUESTS))
    for _ in range(random_.randint(0, 2)):
        key = random_.choice(["do", "seed", "more", ""])
        if random_.random() < 0.3:
            request.pop(key, None)
        else:
            request[key] = random_.choice(STRANGE)
    data = bytearray(messages.text(json.dumps(request)))
    for _ in range(random_.choice([0, 0, 1, 3])):
        data[random_.randrange(len(data))] = random_.randrange(256)
    return bytes(data[: random_.randint(0, len(data))] if random_.random() < 0.1 else data)


def damage_of(data: bytes) -> str:
    """Why it is no request at all; empty if it may be one."""
    try:
        messages.read_json(data)
    except DeploymentError as error:
        return str(error)
    return ""


def test_a_changed_request_is_heeded_or_refused_with_a_reason():
    bench, refused = Bench(CatchEnvCfg()), set[str]()
    requests = bench.node.publisher(COMMAND)
    for number in range(NUM_CHANGES):
        data = changed(random.Random(number))
        requests.publish(data)
        bench.cycle()
        reason = bench.lab_node.state()["refused"]
        json.dumps(reason)
        refused.add(reason)
        assert not (damage := damage_of(data)) or reason == damage
    assert "" in refused
    assert len(refused) > 10
