"""What a simulated robot would have recorded: for rehearsals, and where the truth must be known."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator

from pixel2catch.errors import InvalidValueError
from pixel2catch.identification.fit_simulation import FIT_DT, SETTLING, RecordedMotion
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.trajectory import Trajectory
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robot.joint_dynamics import JointDynamics

STALLED_TURN = 0.04
"""Length of a turn of a loop that stalls [s]. Source: a real UR5 recording, where 5 % of them did."""


MIN_PHYSICS_HZ = 120.0
"""Fewest physics steps in a second. Source: paper, the rate of a training."""


@dataclass(frozen=True, kw_only=True)
class RecorderCfg:
    """How motion is commanded and recorded: two loops that know nothing of each other.

    Attributes:
        noise: Standard deviation of a measured position [rad]. Default: a UR's encoders.
        stall: Share of each loop's turns that take 40 ms.
        send_period: Turn of the loop that sends targets [s].
        read_period: Turn of the loop that reads positions [s].
        clock_offset: By how much the clock of the measurements is ahead of that of the commands [s].
            Positions cannot tell it from latency.
        physics_hz: Physics steps in a second; a fit with as many finds the truth best.
    """

    noise: float = 2e-4
    stall: float = 0.05
    send_period: float = 0.008
    read_period: float = 0.008
    clock_offset: float = 0.0
    physics_hz: float = 1.0 / FIT_DT

    def __post_init__(self) -> None:
        """Refuse what no recorder does."""
        if not 0.0 <= self.noise < 1.0:
            raise InvalidValueError(f"noise is {self.noise}; it must be from 0 to below 1 rad")
        if not 0.0 <= self.stall < 1.0:
            raise InvalidValueError(f"stall is {self.stall}; it is a share of turns, from 0 to below 1")
        for name in ("send_period", "read_period"):
            if not 0.0 < getattr(self, name) <= STALLED_TURN:
                raise InvalidValueError(
                    f"{name} is {getattr(self, name):g} s; it must be up to {STALLED_TURN} s"
                )
        if not MIN_PHYSICS_HZ <= self.physics_hz < np.inf:
            raise InvalidValueError(
                f"physics_hz is {self.physics_hz:g}; it must be {MIN_PHYSICS_HZ:g} or more"
            )


def turns_of_a_loop(
    rng: Generator, seconds: float, period: float, stall: float
) -> Float64[np.ndarray, " num_turns"]:
    """When the turns of a loop begin [s]: the first at 0, all before `seconds`; some are late."""
    lengths = np.where(rng.random(int(np.ceil(seconds / period))) < stall, STALLED_TURN, period)
    times = np.concatenate(([0.0], np.cumsum(lengths)[:-1]))
    return times[times < seconds]


def simulated_recordings(
    trajectories: Sequence[Trajectory], truth: JointDynamics, cfg: RecorderCfg, rng: Generator
) -> list[Recording]:
    """What a robot with these dynamics would have recorded of some trajectories, each from its start pose.

    Args:
        trajectories: What it is sent; all of the joints of `truth`.
        truth: Its dynamics.
        cfg: How it is recorded.
        rng: Draws noise and stalls.
    """
    blanks = [_blank(trajectory, cfg, rng) for trajectory in trajectories]
    (path,) = RecordedMotion(blanks, 1.0 / cfg.physics_hz).simulate([truth])
    recordings = []
    for blank in blanks:
        num_settled = np.count_nonzero(blank.t_meas - blank.t_meas[0] > SETTLING)
        simulated, path = path[:num_settled], path[num_settled:]
        q = np.concatenate((blank.q[: len(blank.q) - num_settled], simulated))
        noise = cfg.noise * rng.standard_normal(q.shape)
        recordings.append(dataclasses.replace(blank, q=q + noise, t_meas=blank.t_meas + cfg.clock_offset))
    return recordings


def rehearse(
    folder: Path, trajectories: Sequence[Trajectory], truth: JointDynamics, cfg: RecorderCfg, seed: int
) -> None:
    """Write what a robot would have recorded of some trajectories, and its dynamics.

    Args:
        folder: A new or empty folder; it gets recording-1.npz and so on, and truth.json.
        trajectories: What the robot is sent.
        truth: Its dynamics.
        cfg: How it is recorded.
        seed: Seed of noise and stalls.
    """
    recordings = simulated_recordings(trajectories, truth, cfg, np.random.default_rng((seed, 1)))
    folder.mkdir(parents=True, exist_ok=True)
    for number, recording in enumerate(recordings, start=1):
        recording.save(folder / f"recording-{number}.npz")
    DynamicsFile(dynamics=truth).save(folder / "truth.json")


def _blank(trajectory: Trajectory, cfg: RecorderCfg, rng: Generator) -> Recording:
    """Commands and times of a recording, with the positions of the start pose."""
    t_cmd = turns_of_a_loop(rng, trajectory.duration, cfg.send_period, cfg.stall)
    t_cmd = np.append(t_cmd, trajectory.duration)
    start = rng.uniform(0.0, cfg.read_period)
    t_meas = start + turns_of_a_loop(rng, trajectory.duration - start, cfg.read_period, cfg.stall)
    return Recording(
        joints=trajectory.joints,
        t_cmd=t_cmd,
        q_cmd=trajectory.at(t_cmd),
        t_meas=t_meas,
        q=np.repeat(trajectory.positions[:1], len(t_meas), axis=0),
    )


def unlike_nominal(rng: Generator, joints: Sequence[str], latency: float = 0.012) -> JointDynamics:
    """Dynamics that differ from the nominal ones by up to 40 % in every parameter.

    Args:
        rng: Draws them.
        joints: Names, in joint order.
        latency: Delay of the commands [s].
    """
    nominal = JointDynamics.nominal(joints)
    names = ("stiffness", "damping", "frictionloss", "armature")
    factors = {name: getattr(nominal, name) * rng.uniform(0.7, 1.4, len(nominal.joints)) for name in names}
    return nominal.with_values(**factors, latency=latency)
