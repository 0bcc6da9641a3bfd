"""The transport of a name."""

from pixel2catch.errors import DeploymentError, UnknownNameError
from pixel2catch.installation import install_command
from pixel2catch.ros2.transport import Reachable, RealClock, Transport

TRANSPORTS = {
    "dds": install_command("deployment"),
    "ros": "source ROS 2 (. /opt/ros/*/setup.sh) and use its Python, or take the transport dds",
}
"""Names of the transports, and how to get what they need."""


def make_transport(name: str, node_name: str, network: str, clock: RealClock) -> Transport:
    """Join a network, a `NetworkName`, by one of `TRANSPORTS`.

    Raises:
        UnknownNameError: There is no such transport or network.
        DeploymentError: Its library is missing, or it cannot be started.
    """
    if name not in TRANSPORTS:
        raise UnknownNameError("transport", name, TRANSPORTS)
    Reachable().require("network", network)
    try:
        if name == "dds":
            from pixel2catch.ros2.dds import DdsTransport

            return DdsTransport(node_name, clock, network=network)
        from pixel2catch.ros2.rclpy_node import RosTransport

        return RosTransport(node_name, clock, network=network)
    except ImportError as error:
        raise DeploymentError(
            f"the transport '{name}' cannot be loaded ({error}): {TRANSPORTS[name]}."
        ) from error
