"""Scripted catches of small objects on one palm and of large ones between two; a policy that imitates them.

The script knows throw and radius. Palms wait beside where they meet the object, tilted to each other and
towards the thrower; they go along with it when it comes, and fingers close. It is played as evaluations are;
a policy of any method, as of `object_extent`, learns its actions in states that the script and it come to.

Run: python benchmarks/two_palms.py --throws 600 --out runs/two-scripted
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro
from torch import Tensor

from pixel2catch.agents import commands_of
from pixel2catch.cli.console import prepare
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import SIZES_TASK
from pixel2catch.evaluation.metrics import metrics
from pixel2catch.evaluation.protocol import Actor, EvaluationCfg, Trials, run_round
from pixel2catch.mdp.control_step import take
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.methods import Method, find_method
from pixel2catch.policy import HIDDEN, Policy, contract_of
from pixel2catch.robots.geometry import Chain, chain_of
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY
from pixel2catch.scene.objects import OBJECTS, SIZES, largest_radius
from pixel2catch.workcells import find_workcell

WORKCELL = find_workcell("two_ur5e_allegro")
FARTHEST_X = 0.88  # where an object is met at the farthest [m]
NOISE = 0.1  # of actions, while states for imitation are collected
HUBER = 0.1  # Difference of actions from which on it counts linearly: where two ways blur, one is chosen.
BATCH = 2  # of a gradient step of imitation, transitions of each environment

SIZE_NAMES = ("6", "10", "16", "22", "28")  # In the names of objects [cm], and of the columns of the table.
CATCH: dict[str, tuple] = {
    # Of the palms to each other, and towards the thrower, before they go along and after [degrees].
    "tilt": ((-7.1, -14.6), (-8.1, -16.2), (52.9, 55.9), (55.2, 47.3), (56.2, 52.6)),
    "lean": ((47.1, 40.6), (35.8, 41.4), (31, 34.1), (21, 31.9), (30.7, 20.8)),
    # Between palm and the ball of the object's volume, and of that from the palm's middle to the fingers [m].
    "gap": ((0.014, -0.003), (0.015, 0.008), (0.04, 0.007), (0.039, 0.023), (0.038, 0.01)),
    "along": ((0.03, 0.027), (0.035, 0.038), (-0.003, 0.024), (-0.002, 0.018), (-0.004, 0.061)),
    # Height of the meeting over the aim, and how much lower the palms are than that [m].
    "above": (0.099, 0.099, 0.101, 0.093, 0.128),
    "below": (0.007, -0.001, 0.021, 0.01, 0.021),
    # Time before the meeting at which they begin to go along [s], and how far they go [m].
    "lead": (0.082, 0.079, 0.08, 0.088, 0.065),
    "give": (0.221, 0.217, 0.134, 0.149, 0.174),
    # Angles of the fingers' first joints and of the others, before and after [rad]; the ring finger's share.
    "first": ((0.46, 1.87), (0.29, 1.63), (0.16, 0.12), (0.29, 0.17), (0.42, 0.15)),
    "others": ((0.19, 0.76), (0.15, 0.54), (0.36, 0.61), (0.21, 0.79), (0.2, 0.75)),
    "ring": (1.36, 1.43, 0.06, -0.06, 0.3),
    # Of the thumb's joints, and of its first one, afterwards [rad].
    "thumb": (1.35, 0.95, 1.41, 1.58, 1.45),
    "thumb_base": (0.51, 0.73, 0.05, -0.16, -0.11),
    "palms": (1, 1, 2, 2, 2),  # One: the nearer.
}
"""Where palms and fingers wait and go. Source: ours, by the cross-entropy method."""


class Script:
    """Chooses the actions of a scripted catch in every environment."""

    def __init__(self, env: CatchEnv) -> None:
        """Plan with the table `CATCH`; the first action plans."""
        self._env, self._is_planned = env, False
        self._table = {name: self._tensor(rows) for name, rows in CATCH.items()}
        self._chains = [chain_of(WORKCELL, palm, env.device, torch.float64) for palm in WORKCELL.palms]
        rows = [(c.anchor, c.offset, c.scale, c.lower, c.upper) for c in commands_of(WORKCELL)]
        self._commands = self._tensor(rows).T

    def act(self, observations: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The action of every agent; the script knows more than its observations."""
        env, steps = self._env, self._env.episode.record.steps
        if not self._is_planned:
            self._plan()
        time = (steps - self._hover_steps).double() * CONTROL_DT
        self._is_touched |= env._sensors.now.is_touching.any(dim=-1)
        is_flying = time >= 0.0
        goes_along = is_flying & (self._is_touched | (time > self._duration - self._catch["lead"]))
        joint_pos = env.measurement.joint_pos.double()
        target = joint_pos.clone()
        for palm, (home, before, after, is_called) in zip(WORKCELL.palms, self._poses, strict=True):
            there = torch.where(goes_along[:, None], after, before)
            target[:, palm.carriers] = torch.where((is_flying & is_called)[:, None], there, home)
        for column, joint in enumerate(WORKCELL.joints):
            if "index" in joint.name or "middle" in joint.name or "ring" in joint.name:
                which = "first" if joint.name.endswith("_1") else "others"
                angle = torch.where(goes_along, self._catch[which][:, 1], self._catch[which][:, 0])
                target[:, column] = angle * (self._catch["ring"] if "ring" in joint.name else 1.0)
            elif "thumb" in joint.name:
                angle = self._catch["thumb_base" if joint.name.endswith("_0") else "thumb"]
                target[:, column] = torch.where(goes_along, angle, 0.0)
        anchor, offset, scale, lower, upper = self._commands
        action = (target.clamp(lower, upper) - anchor * joint_pos - offset) / scale
        return {
            agent.name: take(action.clamp(-1.0, 1.0).float(), agent.joints) for agent in env.method.agents
        }

    def _plan(self) -> None:
        """Where and when the object is met, and the arms' joints there, before and after."""
        env, throw = self._env, self._env.episode.throw
        radii = self._tensor([OBJECTS[name].radius for name in env.world.objects.names])
        objects = env.episode.record.object_id
        sizes, radius = _sizes(env)[objects], radii[objects]
        catch = {name: rows[sizes] for name, rows in self._table.items()}
        pos, speed = throw.pos.double(), throw.lin_vel.double()
        rise = throw.aim[:, 2].double() + catch["above"] - pos[:, 2]
        root = (speed[:, 2] ** 2 - 2.0 * GRAVITY * rise).clamp(min=0.0).sqrt()
        duration = (speed[:, 2] + root) / GRAVITY
        duration = torch.maximum(duration, (pos[:, 0] - FARTHEST_X) / -speed[:, 0])
        met = pos + speed * duration[:, None]
        met[:, 2] -= 0.5 * GRAVITY * duration**2
        speed[:, 2] -= GRAVITY * duration
        along = met + catch["give"][:, None] * torch.nn.functional.normalize(speed, dim=-1)
        self._poses = []
        for side, palm, chain in zip((1.0, -1.0), WORKCELL.palms, self._chains, strict=True):
            joints = WORKCELL.joints[palm.carriers]
            limits = self._tensor([(j.lower, j.upper, j.home) for j in joints])
            start, ways = limits[:, 2].expand(len(met), -1), list[Tensor]()
            for when, place in enumerate((met, along)):
                start = inverse(chain, limits, _palm_pose(catch, when, side, place, radius), start)
                ways.append(start)
            self._poses.append((limits[:, 2], *ways, (catch["palms"] > 1) | (side * met[:, 1] >= 0.0)))
        self._catch, self._duration, self._hover_steps = catch, duration, throw.hover_steps.clone()
        self._is_touched, self._is_planned = torch.zeros_like(self._hover_steps, dtype=torch.bool), True

    def _tensor(self, rows: Sequence) -> Tensor:
        return torch.tensor(rows, dtype=torch.float64, device=self._env.device)


def _sizes(env: CatchEnv) -> Tensor:
    """The column of the table of each object of an environment, -1 of those that are not of `SIZES`."""
    columns = {name: SIZE_NAMES.index(name.split("_")[1]) for name in SIZES}
    return torch.tensor([columns.get(name, -1) for name in env.world.objects.names], device=env.device)


def _palm_pose(
    catch: Mapping[str, Tensor], when: int, side: float, place: Tensor, radius: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Position [m], normal and direction of the fingers of a palm that meets an object at a place."""
    tilt, lean = (torch.deg2rad(catch[name][:, when]) for name in ("tilt", "lean"))
    normal = torch.stack((lean.sin() * tilt.cos(), -side * tilt.sin(), lean.cos() * tilt.cos()), dim=-1)
    fingers = torch.stack((lean.cos(), torch.zeros_like(lean), -lean.sin()), dim=-1)
    pos = place - (radius + catch["gap"][:, when])[:, None] * normal
    pos = pos - catch["along"][:, when, None] * fingers
    pos[:, 2] -= catch["below"]
    return pos, normal, fingers


def inverse(
    chain: Chain, limits: Tensor, pose: tuple[Tensor, Tensor, Tensor], start: Tensor, steps: int = 40
) -> Tensor:
    """Joints [rad] of a palm's pose, by Levenberg's steps within `limits` (lower, upper, home).

    2 cm weigh as much as 0.1 of the normal, 0.7 of the fingers' direction and 20 rad from home.
    """
    pos, normal, fingers = pose
    lower, upper, home = limits.T

    def error(joints: Tensor) -> Tensor:
        site = chain.link_poses(joints)[:, -1]
        off = (
            (site[:, :3, 3] - pos) / 0.02,
            (site[:, :3, 0] - normal) / 0.1,
            (site[:, :3, 2] - fingers) / 0.7,
            (joints - home) / 20.0,
        )
        return torch.cat(off, dim=-1)

    joints, found = start.clone(), error(start)
    weight = start.new_full((len(start), 1, 1), 1e-2)
    nudges = 1e-5 * torch.eye(len(home)).to(start)
    for _ in range(steps):
        slope = torch.stack([(error(joints + nudge) - found) / 1e-5 for nudge in nudges], dim=-1)
        square = slope.mT @ slope
        damped = square + weight * torch.diag_embed(square.diagonal(dim1=1, dim2=2))
        way = torch.linalg.solve(damped, slope.mT @ found[..., None])[..., 0]
        tried = (joints - way.clamp(-0.4, 0.4)).clamp(lower, upper)
        then = error(tried)
        is_better = (then.square().sum(dim=-1) < found.square().sum(dim=-1))[:, None]
        joints, found = torch.where(is_better, tried, joints), torch.where(is_better, then, found)
        weight = torch.where(is_better[..., None], 0.4 * weight, 4.0 * weight).clamp(1e-7, 1e6)
    return joints


def throws_task(episode: EpisodeCfg) -> CatchEnvCfg:
    """Throws of `sizes` as they are in training."""
    scene = replace(SIZES_TASK.scene, workcell=WORKCELL.name, physics_hz=120.0, cone="pyramidal")
    return replace(SIZES_TASK, scene=scene, episode=episode)


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is played, and learnt."""

    throws: int = 600
    seed: int = 1000
    method: str = "object_extent"  #: Of the policy.
    rounds: int = 8  #: Of imitation.
    steps: int = 200  #: Gradient steps of a round, 8 times in the last.
    hidden: tuple[int, ...] = HIDDEN  #: Sizes of the policy's layers.
    num_envs: int = 256  #: Of a round of imitation.
    device: str = "cpu"  #: To play and learn on.
    out: Path | None = None  #: Folder of a policy that imitates the script.


def imitated(method: Method, options: Options) -> Policy:
    """A policy of the script's actions, in states that the script comes to, and later the policy.

    Source: Ross et al. 2011 (DAgger), and noise on the actions.
    """
    num_envs, device = options.num_envs, options.device
    contract = replace(contract_of(method, WORKCELL), task="sizes", object_radius=largest_radius(SIZES))
    policy = Policy(contract, options.hidden).to(device)
    optimizer = torch.optim.Adam(policy.parameters())
    pairs = {agent.name: (list[Tensor](), list[Tensor]()) for agent in method.agents}
    task = throws_task(EpisodeCfg(max_steps=125, rest_steps=40))
    env = CatchEnv(task, method, num_envs=num_envs, device=device)
    for number in range(options.rounds):
        env.seed(3000 + number)
        script, observed = Script(env), env.reset().policy
        is_scripted = torch.rand(num_envs, 1, device=device) < (1.0, 0.45, 0.3, 0.15, 0.0)[min(number, 4)]
        is_running, is_caught = torch.ones(2, num_envs, dtype=torch.bool, device=device)
        while is_running.any():
            wanted, actions = script.act(observed), policy.act(observed)
            for name, (inputs, outputs) in pairs.items():
                inputs.append(observed[name][is_running])
                outputs.append(wanted[name][is_running])
                disturbed = actions[name] + NOISE * torch.randn_like(actions[name])
                actions[name] = torch.where(is_scripted, wanted[name], disturbed)
            step = env.step(actions)
            is_caught = torch.where(is_running, step.record.is_success, is_caught)
            observed, is_running = step.observation.policy, is_running & ~step.terminated
        num_steps = options.steps * (1 if number < options.rounds - 1 else 8)
        learn(policy, optimizer, pairs, num_steps, BATCH * num_envs)
        rates = f"S.R. {is_caught.float().mean():.2f}, {is_scripted.float().mean():.2f} scripted"
        print(f"round {number}: {rates}", flush=True)
    env.close()
    return policy


def learn(
    policy: Policy, optimizer: torch.optim.Optimizer, pairs: Mapping, num_steps: int, batch_size: int
) -> None:
    """Gradient steps on Huber's loss of the actions; inputs are scaled at the first call."""
    for name, lists in pairs.items():
        inputs, outputs = (torch.cat(values) for values in lists)
        network = policy.network(name)
        if not network.input_mean.any():
            network.input_mean.copy_(inputs.mean(dim=0))
            network.input_std.copy_(inputs.std(dim=0).clamp(min=0.02))
        for step in range(num_steps):
            batch = torch.randint(len(inputs), (batch_size,), device=inputs.device)
            loss = torch.nn.functional.smooth_l1_loss(network(inputs[batch]), outputs[batch], beta=HUBER)
            optimizer.zero_grad()
            loss.backward()
            optimizer.param_groups[0]["lr"] = 1e-3 * (1.0 - step / num_steps)
            optimizer.step()


def main(options: Options) -> None:
    options = replace(options, device=prepare(options.device))
    method = find_method(options.method, WORKCELL)
    cfg = EvaluationCfg(
        objects=SIZES,
        num_envs=options.throws,
        trials=1,
        seed=options.seed,
        device=options.device,
        task=throws_task(EpisodeCfg()),
    )
    actors: list[Callable[[CatchEnv], Actor]] = [Script]
    if options.out:
        torch.manual_seed(0)
        policy = imitated(method, options)
        policy.save(options.out / "policy")
        actors.append(lambda _: policy)
    for actor in actors:
        env = cfg.make_env(method)
        found = metrics(Trials.concatenate([run_round(env, actor(env))]), env.workcell)
        for name, rates in ({"all": found} | found["objects"]).items():
            columns = ("trials", "tracking_rate", "success_rate", "verified_hold_rate", "hold_palms")
            print(f"{name:8}", *(f"{column} {rates[column] or 0:.3g}" for column in columns))
        print(
            f"robots touched {found['robot_contact_rate']:.3f}, the table {found['table_contact_rate']:.3f}"
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
