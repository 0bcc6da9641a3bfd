import numpy as np
import torch

from paper_robot import ARM_JOINTS
from pixel2catch.evaluation.comparison.figures import arm_points, sample_paths
from pixel2catch.mdp.throws import ThrowCfg, sample_throws
from pixel2catch.robots.geometry import first_chain
from pixel2catch.scene.constants import GRAVITY
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO, UR5E_POS


def test_paths_lead_from_release_to_aim_in_free_fall():
    cfg = ThrowCfg()
    paths = sample_paths(cfg, 30, seed=1)
    throw = sample_throws(cfg, 30, torch.Generator().manual_seed(1))
    assert np.allclose(paths[:, 0], throw.pos, atol=1e-6)
    assert np.allclose(paths[:, -1], throw.aim, atol=1e-5)
    bend = np.diff(paths, n=2, axis=1)
    assert np.allclose(bend[..., :2], 0.0, atol=1e-9)
    flight = np.sqrt(-bend[:, 0, 2] / GRAVITY) * (paths.shape[1] - 1)
    assert np.all((flight > 0.7) & (flight < 1.2))


def test_the_arm_leads_from_the_base_to_the_palm():
    points = arm_points()
    home = torch.tensor([[joint.home for joint in ARM_JOINTS]], dtype=torch.float64)
    assert np.allclose(points[0], UR5E_POS)
    assert np.allclose(points[-1], first_chain(UR5E_ALLEGRO).pose(home)[0][0], atol=1e-6)
