"""The transport in memory in several threads; `test_transports` has the laws of all transports."""

import threading

from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.transport import RealClock, Topic

NUMBER = Topic(name="/number", type=messages.NUMBER)


def test_nodes_in_several_threads_lose_nothing():
    broker = Broker()
    receiver = broker.node(RealClock())
    subscription = receiver.subscription(NUMBER, depth=2000)

    def send(start: int) -> None:
        with broker.node(RealClock()) as node:
            publisher = node.publisher(NUMBER)
            for value in range(start, start + 500):
                publisher.publish(messages.number(value))

    threads = [threading.Thread(target=send, args=[500 * i]) for i in range(4)]
    for thread in threads:
        thread.start()
    received = []
    while any(thread.is_alive() for thread in threads) or receiver.wait(0.0):
        if receiver.wait(0.1):
            received += [messages.read_number(message.data) for message in subscription.take()]
    assert sorted(received) == list(range(2000))
    assert receiver.num_other_publishers(NUMBER) == 0
