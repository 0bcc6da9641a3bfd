"""Where the robot may be, against MuJoCo's own kinematics and collisions."""

from math import pi

import mujoco
import numpy as np
import pytest
import torch
from laws import contains

from paper_robot import ARM_JOINTS, JOINTS
from pixel2catch.robots.geometry import chain_of
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.servo.workspace import HAND_CLEARANCE, Workspace, link_frames
from pixel2catch.workcells import find_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

LOWER, UPPER = np.array([(joint.lower, joint.upper) for joint in JOINTS]).T
HOME = np.array([[joint.home for joint in ARM_JOINTS]])


def model_of(workcell: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = build_model(SceneCfg(workcell=workcell))
    return model, mujoco.MjData(model)


def put(model: mujoco.MjModel, data: mujoco.MjData, joint_pos: np.ndarray) -> None:
    data.qpos[: len(joint_pos)] = joint_pos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)


def test_the_last_frame_is_the_palm_of_training():
    random = np.random.default_rng(0)
    arm_pos = random.uniform(LOWER[:6], UPPER[:6], (50, 6))
    palm_pos, _ = chain_of(UR5E_ALLEGRO, UR5E_ALLEGRO.palms[0]).pose(torch.from_numpy(arm_pos))
    space = Workspace(workcell=UR5E_ALLEGRO).space
    frames = np.array([link_frames(space, row) for row in arm_pos])
    np.testing.assert_allclose(frames[:, -1, :, 3], palm_pos.numpy(), atol=1e-12)


HANDS = ("ur5e_allegro_right", "ur5e_leap")


def geoms_of(model: mujoco.MjModel, *bodies: str, with_children: bool = True) -> list[int]:
    """Return the collision geoms of bodies, with those of their children."""
    found = {model.body(name).id for name in bodies}
    for child in range(min(found), model.nbody if with_children else 0):
        found |= {child} if model.body_parentid[child] in found else set()
    return [g for g in range(model.ngeom) if model.geom_bodyid[g] in found and model.geom_group[g] == 3]


@pytest.mark.parametrize("name", ["ur5e_allegro", *HANDS])
def test_the_boxes_contain_the_hand(name: str):
    """The large box, with the last link; and the small ones, up to 30 % of the clearance."""
    model, data = model_of(name)
    workcell = find_workcell(name)
    palm = workcell.palms[0].spec
    lower, upper = np.array([(joint.lower, joint.upper) for joint in workcell.joints]).T
    boxes, hand = np.array([(palm.lower, palm.upper), *palm.hand]), geoms_of(model, palm.body)
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 3)] * 3), axis=-1).reshape(-1, 3)
    random = np.random.default_rng(6)
    for number in range(150):
        pose = random.uniform(lower, upper)
        put(model, data, np.where(random.random(len(pose)) < 0.5, lower, upper) if number % 2 else pose)
        axes, origin = data.body(palm.body).xmat.reshape(3, 3), data.body(palm.body).xpos
        for geom in geoms_of(model, "wrist_3_link"):
            shape = grid * model.geom_size[geom]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
                radius, half, _ = model.geom_size[geom]
                shape = grid * (radius, radius, half + radius)
                shape /= np.maximum(np.linalg.norm(grid, axis=1, keepdims=True), 1.0)
            own = data.geom_xmat[geom].reshape(3, 3)
            points = (shape @ own.T + data.geom_xpos[geom] - origin) @ axes
            out = np.maximum(boxes[:, :1] - points, points - boxes[:, 1:]).clip(0.0)
            distance_from_box = np.linalg.norm(out, axis=-1)
            assert not distance_from_box[0].any()
            if geom in hand:
                assert distance_from_box[1:].min(axis=0).max() < 0.3 * HAND_CLEARANCE


ANYWHERE = {"lower": (-9.0, -9.0, -9.0), "upper": (9.0, 9.0, 9.0), "clearance": -9.0}
"""A workspace without walls and table."""


@pytest.mark.parametrize("name", HANDS)
def test_no_pose_inside_has_the_hand_near_its_own_arm(name: str):
    """By MuJoCo's distances in any pose; nearly all poses near the start pose are inside."""
    model, data = model_of(name)
    workcell = find_workcell(name)
    joints = workcell.joints
    lower, upper, home = np.array([(joint.lower, joint.upper, joint.home) for joint in joints]).T
    random = np.random.default_rng(7)
    poses = random.uniform(lower, upper, (800, len(joints)))
    about = home[:6] + random.uniform(-0.5, 0.5, (800, 6))
    poses[400:, :6] = about[400:].clip(lower[:6], upper[:6])
    is_inside = contains(Workspace(workcell=workcell, **ANYWHERE), poses[:, :6])
    is_free = np.array([own_distance(model, data, pose) > 0.0 for pose in poses])
    assert not (is_inside & ~is_free).any()
    assert (~is_free[:400]).sum() > 20
    assert is_inside[400:][is_free[400:]].mean() > (0.98 if len(workcell.palms[0].spec.hand) == 1 else 0.9)


def own_distance(model: mujoco.MjModel, data: mujoco.MjData, pose: np.ndarray) -> float:
    """Distance between hand or last link, and forearm or upper arm [m]."""
    put(model, data, pose)
    hand = geoms_of(model, "wrist_3_link")
    arm = geoms_of(model, "upper_arm_link", "forearm_link", with_children=False)
    return min(mujoco.mj_geomDistance(model, data, one, other, 1.0, None) for one in hand for other in arm)


def test_no_pose_inside_touches_the_table():
    """By MuJoCo's collisions near the height of the table; some poses outside touch it."""
    model, data = model_of("ur5e_allegro")
    table, random = model.geom("table").id, np.random.default_rng(3)
    bodies = {model.body(name).id for name in ("base_link", "shoulder_link", "object")}
    still = {geom for geom in range(model.ngeom) if model.geom_bodyid[geom] in bodies}
    lower, upper = np.array(LOWER), np.array(UPPER)
    lower[[1, 2, 3]], upper[[1, 2, 3]] = (-pi, 0.5, 2.1), (0.2, 2.9, 5.0)
    workspace = Workspace(workcell=UR5E_ALLEGRO, lower=(-2.0, -2.0, -2.0), upper=(2.0, 2.0, 2.0))
    num_inside = num_touching = 0
    for pose in random.uniform(lower, upper, (2000, len(JOINTS))):
        put(model, data, pose)
        is_inside = bool(contains(workspace, pose[None, :6])[0])
        is_touching = any(table in geoms and not still & {*geoms} for geoms in data.contact.geom)
        num_inside, num_touching = num_inside + is_inside, num_touching + is_touching
        assert not (is_inside and is_touching), pose
    assert num_inside > 200
    assert num_touching > 200


def test_walls_by_hand():
    """At the start pose the palm is at (0.434, 0.133, 1.391): no wall may be there."""
    assert contains(Workspace(workcell=UR5E_ALLEGRO), HOME).all()
    for side, axis in np.ndindex(2, 3):
        walls = np.array([[-2.0] * 3, [2.0] * 3])
        for is_moved in (False, True):
            workspace = Workspace(workcell=UR5E_ALLEGRO, lower=tuple(walls[0]), upper=tuple(walls[1]))
            assert contains(workspace, HOME).all() != is_moved
            walls[side, axis] = (0.434, 0.133, 1.391)[axis]
