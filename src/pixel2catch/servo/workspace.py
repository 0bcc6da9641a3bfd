"""Where robots may be: arms above the table, each hand in a box and away from its own arm.

An arm is made of capsules, a hand is a box that contains it in every position of the fingers. A hand whose
robot declares smaller boxes also keeps away from its own forearm and upper arm. Base and shoulder stand on
the table. Collisions between arms, or between fingers, are left to the policy.

A tick is allowed only if the arms can brake inside the workspace after it. Frames are (3, 4), a rotation and
a translation, in the world [m].
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from pixel2catch.robots.geometry import TABLE_CLEARANCE, arm_shape, chain_of
from pixel2catch.robots.spec import Vec3
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.servo.laws import Record, Records, braked_position, braked_speed, clipped, entry

HAND_CLEARANCE = 0.01  #: Distance of a hand to its own arm [m]. Source: ours.
MOST_POSES = 32  #: Ticks of braking that are all checked. Source: ours.
STRIDE = 8  #: Step between the ticks that are checked beyond [ticks]. Source: ours.
HALVINGS = 10  #: Bisection steps for the point of a capsule nearest to a box. Source: ours.
ROUNDING = 1e-9  #: Gap that counts as none [m].


class Space(NamedTuple):
    """A workspace as arrays [m]: joints, capsules and boxes of one arm after the other."""

    columns: Int64[np.ndarray, " watched"]  #: Indices in joint order of the joints that carry palms.
    first_joints: Int64[np.ndarray, " arms+1"]  #: Index of each arm's first of them, and their number.
    first_capsules: Int64[np.ndarray, " arms+1"]  #: Index of each arm's first capsule, and their number.
    first_boxes: Int64[np.ndarray, " arms+1"]  #: Index of each hand's first small box, and their number.
    terms: Float64[np.ndarray, "watched 3 3 4"]  #: Constant, cosine and sine terms of each joint's frame.
    links: Int64[np.ndarray, " capsules"]  #: Joint before each capsule.
    ends: Float64[np.ndarray, "capsules 2 3"]  #: Centres of their ends, in the frame after that joint.
    radii: Float64[np.ndarray, " capsules"]
    is_reached: Bool[np.ndarray, " capsules"]  #: Which of them the hand can reach.
    hands: Float64[np.ndarray, "arms 2 3"]  #: Centre and half extents of each hand's box, from the palm.
    boxes: Float64[np.ndarray, "boxes 2 3"]  #: Lower and upper corners of the small boxes, from the palm.
    walls: Float64[np.ndarray, "2 3"]  #: Lowest and highest corner of the space for the hands.
    table: Float64[np.ndarray, "2 3"]  #: Corners of the table with its clearance, from the floor to the top.


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """Limits of arms and hands in the world frame."""

    workcell: WorkcellSpec
    clearance: float = TABLE_CLEARANCE  #: Distance to the table's top and sides [m].
    #: Lowest and highest corner of the space for the hands [m].
    #: Source: ours; the shipped policies stay 8 cm or more inside.
    lower: Vec3 = (0.0, -1.1, 0.35)
    upper: Vec3 = (1.25, 1.1, 1.85)

    @cached_property
    def space(self) -> Space:
        """Arrays for the compiled laws."""
        palms, table = self.workcell.palms, self.workcell.table
        shapes = [arm_shape(self.workcell, palm) for palm in palms]
        chains = [chain_of(self.workcell, palm).matrices.numpy() for palm in palms]
        first_joints = np.cumsum([0, *(chain.shape[1] for chain in chains)])
        links = [shape.links + first for shape, first in zip(shapes, first_joints, strict=False)]
        center, half = np.array(table.center), np.array(table.size) / 2.0 + self.clearance
        near, far = center[:2] - half, center[:2] + half
        return Space(
            columns=_joined(np.r_[palm.carriers] for palm in palms),
            first_joints=first_joints,
            first_capsules=np.cumsum([0, *(len(shape.radii) for shape in shapes)]),
            first_boxes=np.cumsum([0, *(shape.boxes.shape[2] for shape in shapes)]),
            terms=_joined(chain.swapaxes(0, 1)[:, :, :3] for chain in chains),
            links=_joined(links),
            ends=_joined(shape.ends[:, :3].transpose(0, 2, 1) for shape in shapes),
            radii=_joined(shape.radii for shape in shapes),
            is_reached=_joined(np.isin(np.arange(len(shape.radii)), shape.reached) for shape in shapes),
            hands=np.array([(shape.hand_center, shape.hand_half) for shape in shapes]),
            boxes=_joined(shape.boxes.transpose(2, 0, 1) for shape in shapes),
            walls=np.array((self.lower, self.upper)),
            table=np.array(((*near, 0.0), (*far, center[2] + self.clearance))),
        )


def _joined(parts: Iterable[np.ndarray]) -> np.ndarray:
    """Return the concatenated arrays, C-contiguous, the layout for which the servo tick is compiled."""
    return np.ascontiguousarray(np.concatenate([*parts]))


def limit_to_workspace(
    space: Space, joints: Records, recent: np.ndarray, speeds: np.ndarray, limits: Records
) -> None:
    """Scale the requested joint speeds [rad/s] so that the arms can still stop inside the workspace.

    Braking with all joints is always possible, by the tick before. One joint after the other gets its
    requested speed if the arms can still stop. Recent positions are (joints, ticks) [rad], oldest first.
    Where braking takes many ticks, only some are checked until all joints have their speeds.
    """
    moves, requested = False, speeds.copy()
    for joint in space.columns:
        moves |= speeds[joint] != 0.0
    if not moves or (
        can_stop(space, joints, recent, speeds, limits, STRIDE)
        and can_stop(space, joints, recent, speeds, limits, 1)
    ):
        return
    braked = speeds.copy()
    for joint in space.columns:
        speeds[joint] = braked[joint] = braked_speed(joints[joint].velocity, limits[joint])
    for joint in space.columns:
        slower = speeds[joint]
        speeds[joint] = requested[joint]
        if requested[joint] != slower and not can_stop(space, joints, recent, speeds, limits, STRIDE):
            speeds[joint] = slower
    if not can_stop(space, joints, recent, speeds, limits, 1):
        speeds[:] = braked


def can_stop(
    space: Space, joints: Records, recent: np.ndarray, speeds: np.ndarray, limits: Records, stride: int
) -> bool:
    """Return whether arms with these speeds stay in the workspace while they brake in the next ticks.

    Beyond `MOST_POSES` ticks, each `stride`-th is checked, and the last.
    """
    longest = 0.0
    for joint in space.columns:
        longest = max(longest, np.ceil(abs(speeds[joint]) / limits[joint].change) + limits[joint].window)
    command, last = np.empty(len(space.columns)), int(longest) - 1
    step = stride if last >= MOST_POSES else 1
    for tick in range(last % step, last + 1, step):
        for place, joint in enumerate(space.columns):
            speed = float(speeds[joint])
            command[place] = braking_command(joints[joint], recent[joint], speed, tick, limits[joint])
        if not is_inside(space, command):
            return False
    return True


def braking_command(joint: Record, recent: np.ndarray, speed: float, tick: int, limits: Record) -> float:
    """Return the command [rad] of a tick of braking, which begins after one tick of a speed [rad/s]."""
    command, start = 0.0, joint.position + speed * limits.dt
    for number in range(tick + 1 - limits.window, tick + 1):
        if number < 0:
            command += recent[len(recent) + number] * limits.share
        else:
            command += braked_position(start, speed, number, limits) * limits.share
    return command


def is_inside(space: Space, joint_pos: np.ndarray) -> bool:
    """Return whether a robot, by its joints that carry palms [rad], is inside."""
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


@entry
def note_inside(space: Space, poses: np.ndarray, are_inside: np.ndarray) -> None:
    """Note for each pose of the joints that carry palms [rad] whether it is in the workspace."""
    for number in range(len(poses)):
        are_inside[number] = is_inside(space, poses[number])


def dot(one: np.ndarray, other: np.ndarray) -> float:
    """Return the scalar product of the first three numbers."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def link_frames(space: Space, joint_pos: np.ndarray) -> np.ndarray:
    """Return world frames (watched, 3, 4) at the far ends of the links; the last of an arm is the palm's."""
    frames = np.empty((len(joint_pos), 3, 4))
    for arm in range(len(space.hands)):
        first = space.first_joints[arm]
        for link in range(first, space.first_joints[arm + 1]):
            terms, frame = space.terms[link], frames[link]
            frame[:] = terms[0] + (cos(joint_pos[link]) * terms[1] + sin(joint_pos[link]) * terms[2])
            if link > first:
                before, own = frames[link - 1], frame.copy()
                for row in range(3):
                    for column in range(4):
                        frame[row, column] = dot(before[row], own[:, column])
                    frame[row, 3] += before[row, 3]
    return frames


def is_hand_inside(space: Space, hand: np.ndarray, palm: np.ndarray) -> bool:
    """Return whether a hand's box is within the walls and clear of the table."""
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


def are_apart(table: np.ndarray, middle: np.ndarray, palm: np.ndarray, half: np.ndarray) -> bool:
    """Return whether a box in the axes of a palm is apart from the box of the table.

    Two boxes are apart if and only if an axis of one of them, or a cross product of two, separates them.
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
            if separates(axis, table, middle, palm, half):
                return True
    return False


def separates(
    axis: np.ndarray, table: np.ndarray, middle: np.ndarray, palm: np.ndarray, half: np.ndarray
) -> bool:
    """Return whether there is a gap along an axis between the table and a box in the axes of a palm."""
    way, reach = 0.0, ROUNDING
    for row in range(3):
        way += axis[row] * (middle[row] - (table[0, row] + table[1, row]) / 2.0)
        reach += abs(axis[row]) * (table[1, row] - table[0, row]) / 2.0
        reach += abs(dot(axis, palm[:, row])) * half[row]
    return abs(way) > reach


def is_above(table: np.ndarray, ends: np.ndarray, radius: float) -> bool:
    """Return whether a capsule is beside the table, or high enough where it is over it."""
    top = table[1, 2] + radius
    if min(ends[0, 2], ends[1, 2]) >= top:
        return True
    enter, leave = clip_to_box(ends, table, radius, 2)
    rise = ends[1, 2] - ends[0, 2]
    return enter > leave or ends[0, 2] + min(enter * rise, leave * rise) >= top


def clip_to_box(ends: np.ndarray, box: np.ndarray, margin: float, num_axes: int) -> tuple[float, float]:
    """Return the shares of a segment at which it enters and leaves a box; reversed if it misses it."""
    enter, leave = 0.0, 1.0
    for axis in range(num_axes):
        slope = ends[1, axis] - ends[0, axis]
        slope = slope if slope != 0.0 else 1e-12
        first = (box[0, axis] - margin - ends[0, axis]) / slope
        last = (box[1, axis] + margin - ends[0, axis]) / slope
        enter, leave = max(enter, min(first, last)), min(leave, max(first, last))
    return enter, leave


def is_near(boxes: np.ndarray, palm: np.ndarray, ends: np.ndarray, clearance: float) -> bool:
    """Return whether a segment is nearer than the clearance to a box in the axes of the palm."""
    own = np.empty((2, 3))
    for axis in range(3):
        shift = dot(palm[:, axis], palm[:, 3])
        for end in range(2):
            own[end, axis] = dot(palm[:, axis], ends[end]) - shift
    for number in range(len(boxes)):
        enter, leave = clip_to_box(own, boxes[number], clearance, 3)
        if enter <= leave and distance(own, enter, leave, boxes[number]) <= clearance:
            return True
    return False


def distance(ends: np.ndarray, first: float, last: float, box: np.ndarray) -> float:
    """Return the distance of a part of a segment from a box [m], up to 0.1 % of the part's length too small.

    The distance is convex along the segment: bisection finds its minimum.
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


def outside(ends: np.ndarray, share: float, box: np.ndarray, axis: int) -> float:
    """Return the signed distance of a point of a segment from a box along one axis [m]; 0 inside."""
    place = ends[0, axis] + share * (ends[1, axis] - ends[0, axis])
    return place - clipped(place, box[0, axis], box[1, axis])
