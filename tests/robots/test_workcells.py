"""Every work cell there is: its model, its chains, its agents, and one from a file of one's own."""

import itertools
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from paper_robot import OWN_CELL
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.envs.world import CatchWorld
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.mdp.control_step import put, take
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import METHODS, find_method, methods_of
from pixel2catch.own_files import import_file
from pixel2catch.policy import contract_of
from pixel2catch.robots.geometry import WorkcellGeometry, bare_model, chain_of
from pixel2catch.robots.spec import Placed
from pixel2catch.robots.ur5e import UR5E
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells import find_workcell, workcells
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO


@pytest.fixture(params=sorted(workcells()))
def workcell(request: pytest.FixtureRequest) -> WorkcellSpec:
    return find_workcell(request.param)


def at_home(workcell: WorkcellSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = build_model(SceneCfg(workcell=workcell.name))
    data = mujoco.MjData(model)
    data.qpos[: len(workcell.joints)] = [joint.home for joint in workcell.joints]
    mujoco.mj_forward(model, data)
    return model, data


def test_the_start_pose(workcell: WorkcellSpec):
    """Joints are in the model's order and within their limits, nothing touches, palms look up.

    Palms are above the table, and near enough to where throws come down, at 0.65 to 0.85 m.
    """
    model, data = at_home(workcell)
    names = [joint.name for joint in workcell.joints]
    assert [model.joint(i).name for i in range(len(names))] == names
    assert [model.actuator(i).name for i in range(model.nu)] == names
    assert all(joint.lower <= joint.home <= joint.upper for joint in workcell.joints)
    assert [(model.geom(c.geom1).name, model.geom(c.geom2).name) for c in data.contact] == []
    for palm in workcell.palms:
        x, y, z = data.site(palm.spec.site).xpos
        assert (data.site(palm.spec.site).xmat.reshape(3, 3) @ palm.spec.normal)[2] > 0.95
        assert 0.35 < x < 0.75
        assert abs(y) < 0.65
        assert 1.2 < z < 1.5
        tips = np.mean([data.site(finger.tip).xpos for finger in palm.spec.fingers], axis=0)
        assert tips[0] > x


def test_nothing_flies_through_the_wrist(workcell: WorkcellSpec):
    """Rays across the line from an arm's last joint to its flange hit the robot, from 12 % of the way on."""
    model, data = at_home(workcell)
    for palm, placed in zip(workcell.palms, workcell.robots, strict=True):
        start = data.joint(workcell.joints[palm.carriers][-1].name).xanchor
        line = data.site(placed.prefix + placed.robot.mount).xpos - start
        across = np.linalg.svd(line[None])[2][1:]
        for share, side in itertools.product(np.linspace(0.12, 0.99, 30), (*across, *-across)):
            origin, hit = start + share * line + 0.2 * side, np.zeros(1, dtype=np.int32)
            distance = mujoco.mj_ray(model, data, origin, -side, np.eye(6, dtype=np.uint8)[3], 1, -1, hit)
            assert 0.0 <= distance < 0.2, share


def test_a_palm_can_be_under_every_throw_and_look_up(workcell: WorkcellSpec):
    """At the corners of where throws come down, by inverse kinematics; as it looks up at the start."""
    model, data = at_home(workcell)
    home, throws = data.qpos.copy(), ThrowCfg()
    errors = np.full((4, len(workcell.palms)), np.inf)
    for column, palm in enumerate(workcell.palms):
        site, joints = data.site(palm.spec.site), workcell.joints[palm.carriers]
        lower, upper = np.array([(joint.lower, joint.upper) for joint in joints]).T
        data.qpos[:] = home
        mujoco.mj_kinematics(model, data)
        up = site.xmat.reshape(3, 3)[2].copy()

        def error(joint_pos, aim, site=site, up=up, columns=palm.carriers):
            data.qpos[columns] = joint_pos
            mujoco.mj_kinematics(model, data)
            return np.append((site.xpos - aim) / 0.05, site.xmat.reshape(3, 3) @ up - (0.0, 0.0, 1.0))

        start = np.clip(home[palm.carriers], lower + 1e-3, upper - 1e-3)
        for row, aim in enumerate(itertools.product(throws.aim_x, throws.aim_y, throws.aim_z[1:])):
            found = least_squares(error, start, bounds=(lower, upper), args=(aim,), max_nfev=50)
            errors[row, column] = np.linalg.norm(found.fun)
    assert errors.min(axis=1).max() < 0.3  # 1.5 cm, or 17 degrees


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 4e-6)])
def test_chains_agree_with_the_model(workcell: WorkcellSpec, dtype: torch.dtype, tolerance: float):
    """Of a quaternion and its opposite, that on the side of the start pose is given."""
    model, data = at_home(workcell)
    lower, upper = np.array([(joint.lower, joint.upper) for joint in workcell.joints]).T
    generator = np.random.default_rng(0)
    for palm in workcell.palms:
        chain = chain_of(workcell, palm, dtype=dtype)
        assert chain.joints == tuple(joint.name for joint in workcell.joints[palm.carriers])
        for _ in range(20):
            joint_pos = generator.uniform(lower, upper)
            data.qpos[: len(joint_pos)] = joint_pos
            mujoco.mj_kinematics(model, data)
            pos, quat = chain.pose(torch.tensor(joint_pos[None, palm.carriers], dtype=dtype))
            assert quat[0] @ chain.side >= 0.0
            site, matrix = data.site(palm.spec.site), np.zeros(9)
            mujoco.mju_quat2Mat(matrix, quat[0].double().numpy())
            np.testing.assert_allclose(pos[0].numpy(), site.xpos, atol=tolerance)
            np.testing.assert_allclose(matrix, site.xmat, atol=tolerance)
    if workcell is UR5E_ALLEGRO:
        side = chain_of(workcell, workcell.palms[0], dtype=dtype).side
        assert side.tolist() == pytest.approx((0.0, -0.777, 0.0, -0.629), abs=1e-3)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def test_a_random_roll_out(workcell: WorkcellSpec, device: str):
    assert list(methods_of(workcell)) == list(METHODS)
    method = find_method("proposed+fit", workcell)
    env = CatchEnv(CatchEnvCfg(scene=SceneCfg(workcell=workcell.name)), method, num_envs=3, device=device)
    assert sum(env.action_sizes.values()) == len(workcell.joints)
    contract = contract_of(method, workcell)
    assert {n: agent.num_inputs for n, agent in contract.agents.items()} == env.observation_sizes
    generator = torch.Generator(device).manual_seed(0)
    step = env.step({n: torch.zeros(3, size, device=device) for n, size in env.action_sizes.items()})
    for _ in range(5):
        actions = {
            n: torch.rand(3, size, generator=generator, device=device) * 2 - 1
            for n, size in env.action_sizes.items()
        }
        step = env.step(actions)
    assert all(torch.isfinite(value).all() for value in (*step.rewards.values(), step.observation.state))
    env.check()
    env.close()


def test_an_agent_for_each_robot():
    two = find_workcell("two_ur5e_allegro")
    left, right = find_method("agent_per_robot", two).agents
    assert [left.name, right.name] == ["left_robot", "right_robot"]
    assert [left.joints, right.joints] == [(slice(0, 19),), (slice(19, 38),)]
    assert [left.palms, right.palms] == [(slice(0, 1),), (slice(1, 2),)]
    (both,) = find_method("single_agent", two).agents
    assert (*left.reward_names, *right.reward_names) == both.reward_names
    assert METHODS["agent_per_robot"].agents == METHODS["single_agent"].agents


def test_robots_that_hit_each_other_are_told_from_one_that_touches_itself():
    """Arms turned to each other, and one folded onto its foot; agents of two pay for the first alone."""
    workcell = find_workcell("two_ur5e_allegro")
    world = CatchWorld(SceneCfg(workcell=workcell.name), None, num_envs=3, device="cpu")
    joint_pos = world.simulation.bind("qpos")[:, : len(workcell.joints)]
    joint_pos[:] = torch.tensor([joint.home for joint in workcell.joints])
    for name, pan in (("left_arm", -1.0), ("right_arm", 0.6)):
        start = workcell.columns(name).start
        joint_pos[1, start : start + 2] += torch.tensor([pan, 0.5])  # and down, for the palms to meet
    joint_pos[2, 1:3] = torch.tensor([0.0, 0.9 * np.pi])
    target = joint_pos.clone()
    world.simulation.forward(torch.ones(3, dtype=torch.bool))
    found = world.privileged(world.run(target, num_steps=1))
    assert found.is_robot_contact.tolist() == [False, True, False]
    assert found.is_self_contact.tolist() == [False, True, True]
    names = {agent.name: agent.reward_names for agent in find_method("proposed", workcell).agents}
    assert all(f"{name}.robot_contact" in terms for name, terms in names.items())
    assert not any("robot_contact" in name for a in METHODS["proposed"].agents for name in a.reward_names)


def test_columns_that_do_not_follow_each_other():
    """Two arms of one agent, with the hands of another between and after them."""
    arms, hands = (slice(0, 6), slice(19, 25)), (slice(6, 19), slice(25, 38))
    whole = torch.arange(76.0).view(2, 38)
    left, _, right, _ = find_method("proposed", find_workcell("two_ur5e_allegro")).agents
    assert ((left + right).joints, (left + right).num_joints) == (arms, 12)
    assert take(whole, arms)[0].tolist() == [*range(6), *range(19, 25)]
    assert torch.equal(put([(hands, take(whole, hands)), (arms, take(whole, arms))]), whole)


def test_depth_in_the_table_is_of_the_arm_that_is_in_it():
    two = find_workcell("two_ur5e_allegro")
    joint_pos = torch.tensor([[joint.home for joint in two.joints]])
    joint_pos[0, 20] = 0.2  # the right arm lies down
    left, right = WorkcellGeometry(two).depth_in_table(joint_pos)[0]
    assert left == 0.0
    assert right > 0.1


def test_a_work_cell_of_ones_own(tmp_path: Path):
    file = tmp_path / "mine.py"
    file.write_text(OWN_CELL)
    import_file(str(file))
    mine = find_workcell("mine")
    moved = WorkcellGeometry(mine).palm_poses(torch.zeros(1, 19))[0]
    home = WorkcellGeometry(UR5E_ALLEGRO).palm_poses(torch.zeros(1, 19))[0]
    torch.testing.assert_close(moved - home, torch.tensor([[[0.1, 0.0, 0.0]]]))


def test_faults_are_named():
    with pytest.raises(UnknownNameError, match="ur5e_allegro"):
        find_workcell("ur10_allegro")
    with pytest.raises(InvalidValueError, match="has no palm"):
        WorkcellSpec(name="bare", robots=(Placed(robot=UR5E, pos=(0.0, 0.0, 0.8)),))
    (robot,) = UR5E_ALLEGRO.robots
    with pytest.raises(InvalidValueError, match="give robots prefixes"):
        replace(UR5E_ALLEGRO, robots=(robot, robot))
    palm = replace(UR5E_ALLEGRO.palms[0].spec, site="nowhere")
    with pytest.raises(InvalidValueError, match="its MJCF has no site 'nowhere'"):
        bare_model(replace(UR5E_ALLEGRO, robots=(replace(robot, robot=replace(UR5E, palms=(palm,))),)))
