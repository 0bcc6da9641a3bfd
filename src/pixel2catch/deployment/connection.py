"""What is open while a robot is connected."""

from dataclasses import dataclass

from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.servo_link import BrainEnd
from pixel2catch.deployment.tape import Tape
from pixel2catch.deployment.transport import Transport


@dataclass(frozen=True, kw_only=True)
class Connection:
    """Network, servo, clock and recording.

    Attributes:
        transport: The node of the network.
        servo: The brain's end of the link to the servo process.
        servo_dt: Time between two ticks of the servo [s].
        clock: The clock.
        tape: The recording, if there is one.
    """

    transport: Transport
    servo: BrainEnd
    servo_dt: float
    clock: Clock
    tape: Tape | None
