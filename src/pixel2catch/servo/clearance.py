"""Whether arms and hands of one robot are inside their workspace.

Frames are (3, 4), a rotation and a place; all of it in the world [m].
"""

from math import cos, sin, sqrt

import numpy as np
from jaxtyping import Bool, Float64

from pixel2catch.servo.compilation import compiled, entry
from pixel2catch.servo.motion import clipped
from pixel2catch.servo.workspace import Space, Workspace

HAND_CLEARANCE = 0.01  #: Distance of a hand to keep from its own arm [m]. Source: ours.
HALVINGS = 10  #: Of the part of a capsule where it is nearest to a box. Source: ours.
ROUNDING = 1e-9  #: Gap that is none [m], and what an axis across two that are parallel may seem to show.


def contains(
    workspace: Workspace, arm_pos: Float64[np.ndarray, "rows num_watched"]
) -> Bool[np.ndarray, " rows"]:
    """Whether robots whose joints that carry palms are here [rad] are where they may be."""
    return _rows_inside(workspace.space, np.ascontiguousarray(arm_pos))


@entry
def _rows_inside(space: Space, joint_pos: np.ndarray) -> np.ndarray:
    found = np.empty(len(joint_pos), np.bool_)
    for row in range(len(joint_pos)):
        found[row] = is_inside(space, joint_pos[row])
    return found


@compiled
def is_inside(space: Space, joint_pos: np.ndarray) -> bool:
    """Whether a robot whose watched joints are here [rad] is where it may be."""
    frames = link_frames(space, joint_pos)
    ends = np.empty((2, 3))
    for arm in range(len(space.hands)):
        palm = frames[space.first_joints[arm + 1] - 1]
        if not is_hand_inside(space, space.hands[arm], palm):
            return False
        boxes = space.boxes[space.first_boxes[arm] : space.first_boxes[arm + 1]]
        for capsule in range(space.first_capsules[arm], space.first_capsules[arm + 1]):
            frame, radius = frames[space.links[capsule]], space.radii[capsule]
            for end in range(2):
                for axis in range(3):
                    ends[end, axis] = dot(frame[axis], space.ends[capsule, end]) + frame[axis, 3]
            if not is_above(space.table, ends, radius):
                return False
            if space.is_reached[capsule] and is_near(boxes, palm, ends, radius + HAND_CLEARANCE):
                return False
    return True


@compiled
def dot(one: np.ndarray, other: np.ndarray) -> float:
    """The scalar product of the first three numbers."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


@compiled
def link_frames(space: Space, joint_pos: np.ndarray) -> np.ndarray:
    """World frames (watched, 3, 4) at the far ends of the links; of each arm the last is the palm's."""
    frames, own = np.empty((len(joint_pos), 3, 4)), np.empty((3, 4))
    for arm in range(len(space.hands)):
        first = space.first_joints[arm]
        for link in range(first, space.first_joints[arm + 1]):
            cosine, sine, terms = cos(joint_pos[link]), sin(joint_pos[link]), space.terms[link]
            for row in range(3):
                for column in range(4):
                    turned = cosine * terms[1, row, column] + sine * terms[2, row, column]
                    own[row, column] = terms[0, row, column] + turned
            join(frames[link - 1], own, frames[link], link == first)
    return frames


@compiled
def join(before: np.ndarray, own: np.ndarray, frame: np.ndarray, is_first: bool) -> None:
    """Write the world frame of a link, from that of the link before it; the first one is its own."""
    for row in range(3):
        for column in range(4):
            if is_first:
                frame[row, column] = own[row, column]
            else:
                frame[row, column] = dot(before[row], own[:, column])
                frame[row, column] += before[row, 3] if column == 3 else 0.0


@compiled
def is_hand_inside(space: Space, hand: np.ndarray, palm: np.ndarray) -> bool:
    """Whether the box about a hand is within the walls, and clear of the table."""
    middle, is_over, lowest = np.empty(3), True, 0.0
    for axis in range(3):
        middle[axis] = palm[axis, 3] + dot(palm[axis], hand[0])
        half = 0.0
        for row in range(3):
            half += abs(palm[axis, row]) * hand[1, row]
        lower, upper = middle[axis] - half, middle[axis] + half
        if not (lower >= space.walls[0, axis] and upper <= space.walls[1, axis]):
            return False
        lowest = lower
        is_over &= axis == 2 or (lower < space.table[1, axis] and upper > space.table[0, axis])
    return not is_over or lowest >= space.table[1, 2] or are_apart(space.table, middle, palm, hand[1])


@compiled
def are_apart(table: np.ndarray, middle: np.ndarray, palm: np.ndarray, half: np.ndarray) -> bool:
    """Whether a box in the axes of a palm does not reach into the space from the floor to the table's top.

    Two boxes are apart if and only if an axis of one of them, or one across two of them, tells them apart.
    Source: Gottschalk, Lin and Manocha 1996, OBBTree, the separating axis theorem.
    """
    axis = np.empty(3)
    for one in range(-1, 3):
        for other in range(-1, 3):
            for row in range(3):
                after, last = (row + 1) % 3, (row + 2) % 3
                if one < 0:
                    axis[row] = palm[row, other] if other >= 0 else 0.0
                elif other < 0:
                    axis[row] = 1.0 if row == one else 0.0
                else:
                    axis[row] = (after == one) * palm[last, other] - (last == one) * palm[after, other]
            if tells_apart(axis, table, middle, palm, half):
                return True
    return False


@compiled
def tells_apart(
    axis: np.ndarray, table: np.ndarray, middle: np.ndarray, palm: np.ndarray, half: np.ndarray
) -> bool:
    """Whether along an axis there is a gap between the table and a box about a middle."""
    way, reach = 0.0, ROUNDING
    for row in range(3):
        way += axis[row] * (middle[row] - (table[0, row] + table[1, row]) / 2.0)
        reach += abs(axis[row]) * (table[1, row] - table[0, row]) / 2.0
        reach += abs(dot(axis, palm[:, row])) * half[row]
    return abs(way) > reach


@compiled
def is_above(table: np.ndarray, ends: np.ndarray, radius: float) -> bool:
    """Whether a capsule is beside the table, or high enough in that part of it that is over it."""
    top = table[1, 2] + radius
    if min(ends[0, 2], ends[1, 2]) >= top:
        return True
    enter, leave = crossed(ends, table, radius, 2)
    rise = ends[1, 2] - ends[0, 2]
    return enter > leave or ends[0, 2] + min(enter * rise, leave * rise) >= top


@compiled
def crossed(ends: np.ndarray, box: np.ndarray, around: float, num_axes: int) -> tuple[float, float]:
    """Shares of a straight way at which it enters and leaves a box with a margin; none if reversed."""
    enter, leave = 0.0, 1.0
    for axis in range(num_axes):
        slope = ends[1, axis] - ends[0, axis]
        slope = slope if slope != 0.0 else 1e-12
        first = (box[0, axis] - around - ends[0, axis]) / slope
        last = (box[1, axis] + around - ends[0, axis]) / slope
        enter, leave = max(enter, min(first, last)), min(leave, max(first, last))
    return enter, leave


@compiled
def is_near(boxes: np.ndarray, palm: np.ndarray, ends: np.ndarray, around: float) -> bool:
    """Whether a capsule's axis is nearer to a box of the hand, in the axes of the palm, than it may be."""
    own = np.empty((2, 3))
    for axis in range(3):
        shift = dot(palm[:, axis], palm[:, 3])
        for end in range(2):
            own[end, axis] = dot(palm[:, axis], ends[end]) - shift
    for number in range(len(boxes)):
        enter, leave = crossed(own, boxes[number], around, 3)
        if enter <= leave and distance(own, enter, leave, boxes[number]) <= around:
            return True
    return False


@compiled
def distance(ends: np.ndarray, first: float, last: float, box: np.ndarray) -> float:
    """Distance of a straight way, between two shares of it, from a box [m]: up to 0.1 % of it too small.

    The distance from a box is convex along a way: where it is least is found by halving.
    """
    for _ in range(HALVINGS):
        middle, slope = (first + last) / 2.0, 0.0
        for axis in range(3):
            slope += outside(ends, middle, box, axis) * (ends[1, axis] - ends[0, axis])
        first, last = (middle, last) if slope < 0.0 else (first, middle)
    away, length = 0.0, 0.0
    for axis in range(3):
        away += outside(ends, first, box, axis) ** 2
        length += (ends[1, axis] - ends[0, axis]) ** 2
    return sqrt(away) - (last - first) * sqrt(length)


@compiled
def outside(ends: np.ndarray, share: float, box: np.ndarray, axis: int) -> float:
    """How far a point of a straight way is outside a box along one of its axes [m]."""
    place = ends[0, axis] + share * (ends[1, axis] - ends[0, axis])
    return place - clipped(place, box[0, axis], box[1, axis])
