"""The choice of a transport by its name; the library of the one that is not chosen need not be there."""

from pixel2catch.deployment.clock import RealClock
from pixel2catch.deployment.transport import Transport
from pixel2catch.errors import DeploymentError, UnknownNameError

TRANSPORTS = {
    "dds": "pip install 'pixel2catch[deployment]'",
    "ros": "source ROS 2 (. /opt/ros/*/setup.sh) and use its Python, or take the transport dds",
}
"""Names of the transports, and how to get what they need."""


def make_transport(name: str, node_name: str, loopback: bool, clock: RealClock) -> Transport:
    """Join the network.

    Args:
        name: "dds" for DDS by itself, "ros" for rclpy of a sourced ROS 2.
        node_name: Name of the node.
        loopback: Whether to speak to this machine only.
        clock: Tells when messages arrive.

    Raises:
        UnknownNameError: There is no such transport.
        DeploymentError: Its library is missing, or it cannot be started.
    """
    if name not in TRANSPORTS:
        raise UnknownNameError("transport", name, TRANSPORTS)
    try:
        return _join(name, node_name, loopback, clock)
    except ImportError as error:
        raise DeploymentError(
            f"the transport '{name}' cannot be loaded ({error}): {TRANSPORTS[name]}."
        ) from error


def _join(name: str, node_name: str, loopback: bool, clock: RealClock) -> Transport:
    if name == "dds":
        from pixel2catch.deployment.dds import DdsTransport

        return DdsTransport(node_name, clock, loopback=loopback)
    from pixel2catch.deployment.ros import RosTransport

    return RosTransport(node_name, clock, loopback=loopback)
