"""What every control step of a data set has: LeRobot's names of features, and the names of their numbers."""

from pixel2catch.camera.boxes import PIXEL_FEATURES
from pixel2catch.robots.workcell import WorkcellSpec

STATE = "observation.state"  #: Measured joint positions [rad].
ACTION = "action"  #: Joint targets of the policy [rad].
SEEN = "observation.environment_state"  #: Newest box of the object [px], and its pixel features.
AGE = "observation.box_age"  #: Age of that box [control steps]; in simulation only.
REWARD = "next.reward"  #: Sum of the agents' rewards; in simulation only.
DONE = "next.done"  #: Whether the episode ends with this step.
SUCCESS = "next.success"  #: Whether it ends with a catch; in simulation only.
IMAGES = "observation.images.rgb"  #: What the robot's camera sees.

BOX = ("xmin", "ymin", "xmax", "ymax")


def names_of(workcell: WorkcellSpec) -> dict[str, tuple[str, ...]]:
    """Names of the numbers of those features that have several."""
    joints = tuple(joint.name for joint in workcell.joints)
    return {STATE: joints, ACTION: joints, SEEN: (*BOX, *PIXEL_FEATURES)}
