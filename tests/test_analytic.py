"""The analytic policies: their fit, their inverse kinematics, and what they catch and read."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pixel2catch.camera.level import LEVEL_CAMERA
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.deployment.policy_pipeline import PolicyController
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.evaluation.loading import fingerprint, load_policy, task_of
from pixel2catch.evaluation.protocol import EvaluationCfg, run_round
from pixel2catch.mdp.control_step import History, Measurement
from pixel2catch.mdp.throws import ThrowCfg, sample_throws
from pixel2catch.policy.analytic import BallisticFit
from pixel2catch.policy.onnx_policy import to_onnx
from pixel2catch.policy.policy import Policy
from pixel2catch.robots.geometry import chain_of, joints_reaching, pose_and_slopes
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY
from pixel2catch.scene.objects import SEEN
from pixel2catch.shipped import policy_folder
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.stepped import rehearse_stepped
from pixel2catch.workcells import find_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

CELLS = ("ur5e_allegro", "fr3_allegro", "ur5e_leap")
CAMERA = torch.tensor([[-0.39, 0.01, 2.2]], dtype=torch.float64)


def seen_throws(num_throws: int, since: float) -> tuple[torch.Tensor, ...]:
    """Return exact boxes and ages, and true position and velocity, of throws some time after the release."""
    throw = sample_throws(ThrowCfg(), num_throws, torch.Generator().manual_seed(5))
    pos, vel, fall = throw.pos.double(), throw.lin_vel.double(), torch.tensor([0.0, 0.0, -GRAVITY]).double()
    age = torch.arange(1.0, 33.0, dtype=torch.float64).expand(num_throws, -1)
    flown = (since - age * CONTROL_DT).clamp(min=0.0)[..., None]
    points = pos[:, None] + (vel[:, None] + 0.5 * flown * fall) * flown - CAMERA
    center, _ = nominal_projection(LEVEL_CAMERA, points).pixels(points)
    box = torch.cat((center - 10.0, center + 10.0), dim=-1)
    return box, age, pos + (vel + 0.5 * since * fall) * since, vel + since * fall


@pytest.mark.parametrize(("since", "most"), [(0.4, 0.2), (0.6, 0.12), (0.75, 0.05), (0.85, 0.02)])
def test_the_fit_recovers_a_throw_the_better_the_longer_it_flew(since: float, most: float):
    """Without noise only the prior is wrong: by less with each box; across the view it is right at once."""
    box, age, pos, vel = seen_throws(200, since)
    found, speed, is_flying = BallisticFit(ThrowCfg())(box, age, CAMERA.expand(200, 3))
    assert is_flying.all()
    assert (found - pos).norm(dim=-1).max() < most
    assert (found - pos)[:, 1].abs().max() < 0.02
    assert (speed - vel).norm(dim=-1).max() < 5.0 * most


def test_an_object_that_hovers_does_not_fly():
    box, age, _, _ = seen_throws(20, 0.0)
    _, _, is_flying = BallisticFit(ThrowCfg())(box, age, CAMERA.expand(20, 3))
    assert not is_flying.any()


@pytest.mark.parametrize("cell", CELLS)
def test_inverse_kinematics_reach_what_the_arm_can_reach(cell: str):
    workcell = find_workcell(cell)
    (palm,) = workcell.palms
    chain = chain_of(workcell, palm)
    joints = workcell.joints[palm.carriers]
    limits = torch.tensor([[joint.lower for joint in joints], [joint.upper for joint in joints]]).double()
    home = torch.tensor([[joint.home for joint in joints]], dtype=torch.float64)
    torch.manual_seed(0)
    truth = (home + 0.3 * torch.randn(100, len(joints), dtype=torch.float64)).clamp(*limits)
    pose, slopes = pose_and_slopes(chain, truth)
    torch.testing.assert_close(pose[:, :3, 3], chain.pose(truth)[0])
    nudged, _ = pose_and_slopes(chain, truth + 1e-6)
    torch.testing.assert_close((nudged - pose) / 1e-6, slopes.sum(dim=1), atol=1e-4, rtol=0.0)
    normal = torch.tensor(palm.spec.normal, dtype=torch.float64)
    target = pose[:, :3, 3], pose[:, :3, :3] @ normal
    found = joints_reaching(chain, home.expand(100, -1), limits, *target, normal, num_steps=60)
    reached, _ = pose_and_slopes(chain, found)
    assert ((found >= limits[0]) & (found <= limits[1])).all()
    errors = torch.cat((reached[:, :3, 3] - target[0], reached[:, :3, :3] @ normal - target[1]), dim=-1)
    assert (errors.norm(dim=-1) < 5e-3).float().mean() >= 0.9  # others stop at a limit of a joint


@pytest.mark.parametrize(
    ("name", "cell"), [*(("analytic", cell) for cell in CELLS), ("analytic_told", CELLS[0])]
)
def test_a_name_catches_with_every_arm(name: str, cell: str):
    path = Path(f"{name}@{cell}")
    policy, method = load_policy(path)
    assert policy.contract.workcell == cell
    assert len(fingerprint(path)) == 64
    cfg = EvaluationCfg(objects=SEEN, num_envs=8, trials=1, seed=3, task=task_of(policy, 240.0))
    record = run_round(cfg.make_env(method), policy).record
    is_slow = cell == "fr3_allegro"  # it plans without this arm's limit of acceleration
    assert record.is_tracked.sum() >= (2 if is_slow else 6)
    assert record.is_success.sum() >= (1 if is_slow else 3)


def test_a_rehearsal_ends_without_a_fault_of_the_servo():
    """The cup is made early enough that the servo does not take contact for a finger that is astray."""
    policy, _ = load_policy(Path("analytic"))
    cfg = RehearsalCfg(throws=1, seed=180500, plain=True)
    report = rehearse_stepped(cfg, task_of(policy, 120.0), policy, lambda _: None)
    (throw,) = report["throws"]
    assert throw["is_tracked"]
    assert throw["stops"] == []


def waiting(policy: Policy) -> Measurement:
    _, method = load_policy(Path("analytic"))
    return CatchEnv(task_of(policy, 120.0), method, num_envs=4, seed=1).measurement


def act(policy: Policy, measurement: Measurement) -> torch.Tensor:
    method = load_policy(Path("analytic"))[1]
    return policy.act(method.observe(History(measurement, measurement, measurement)))["robot"]


def test_what_is_not_measured_changes_no_action():
    policy, _ = load_policy(Path("analytic"))
    measured = waiting(policy)
    changes = {name: getattr(measured, name) + 1.0 for name in ("object_pos", "initial_object_pos")}
    torch.testing.assert_close(act(policy, replace(measured, **changes)), act(policy, measured))
    flying = measured.boxes.box.clone()
    flying[:, :8, 1::2] -= 60.0
    seen = replace(measured, boxes=replace(measured.boxes, box=flying))
    assert not act(policy, seen).equal(act(policy, measured))


def test_a_hand_that_closes_goes_on_and_a_new_throw_opens_it():
    policy, _ = load_policy(Path("analytic"))
    postures, measured = vars(policy.agents["robot"]), waiting(policy)
    arm, opened, closed = 6, postures["_open"].float(), postures["_closed"].float()
    action = torch.zeros_like(measured.action)
    torch.testing.assert_close(act(policy, measured)[:, arm:], opened.expand(4, -1))
    action[:, :arm], action[:, arm:] = 0.4, 0.5 * (postures["_cup"].float() + closed)
    for _ in range(4):
        action = act(policy, replace(measured, action=action))
    torch.testing.assert_close(action[:, arm:], closed.expand(4, -1))
    assert action[:, :arm].abs().max() < 0.1


def test_refusals():
    two, told = Path("analytic@two_ur5e_allegro"), load_policy(Path("analytic_told"))[0]
    with pytest.raises(InvalidValueError, match="has 2 palms"):
        load_policy(two)
    with pytest.raises(PolicyMismatchError, match="reads object_position, which one camera does not"):
        PolicyController(told, UR5E_ALLEGRO)
    with pytest.raises(PolicyMismatchError, match="without networks"):
        to_onnx(told)
    with pytest.raises(PolicyMismatchError, match="no networks to go on from"):
        Policy.load(policy_folder(Path("analytic")))
