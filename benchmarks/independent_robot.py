"""A robot that shares nothing with our simulation: joints with belts, play, sticking friction and a servo.

A joint is two masses, motor and link, on an elastic belt (semi-implicit Euler, 0.25 ms). The encoder is at
either of them, behind the play of the gear; its zero drifts. Friction of the motor is the LuGre model (Lund
and Grenoble, 1995): bristles that stick, more friction at rest than in motion (Stribeck), the Coulomb level
in motion. That level differs by direction and grows with the torque of the belt. The servo runs at 1 kHz:
commands wait for its cycle, and its pull is held for one, while the drive damps at every step. Commands and
measurements get lost; encoders have steps; the clock of the measurements drifts.
"""

from dataclasses import dataclass

import numpy as np

from pixel2catch.identification.recording import Recording, Trajectory, held
from pixel2catch.identification.rehearsal import turns_of_a_loop

DT = 2.5e-4  # step of the integration [s]
CYCLE = 4  # steps in a cycle of the servo
STRIBECK_SPEED = 0.02  # where friction falls to its level in motion [rad/s] (ours, the order of drives)

JOINTS = {
    "shoulder_pan_joint": (2504.0, 342.0, 4.0, 0.16, 0.8126, 150.0, 5.0, "arm"),
    "shoulder_lift_joint": (2848.0, 353.0, 4.0, 0.15, 2.02, 150.0, 5.0, "arm"),
    "elbow_joint": (2536.0, 343.0, 3.0, 0.14, 1.14, 150.0, 4.0, "arm"),
    "wrist_1_joint": (1681.0, 234.0, 1.2, 0.23, 0.0851, 28.0, 0.8, "arm"),
    "wrist_2_joint": (2243.0, 279.0, 1.2, 0.20, 0.0563, 28.0, 0.8, "arm"),
    "wrist_3_joint": (2066.0, 202.0, 1.0, 0.21, 0.0033, 28.0, 0.8, "arm"),
    "index_joint_1": (3.0, 0.1, 0.02, 1.0e-3, 6.08e-4, 0.5, 0.002, "hand"),
    "index_joint_2": (3.0, 0.1, 0.02, 1.0e-3, 1.17e-4, 0.5, 0.002, "hand"),
    "thumb_joint_3": (3.0, 0.1, 0.02, 1.0e-3, 5.54e-5, 0.5, 0.002, "hand"),
}
"""Middle of what is drawn: stiffness, damping, friction, inertia of motor and link, torque limit, viscous
friction, and role. Source: the nominal robot, but for friction: the order of harmonic drives of that size."""

GEARS = {"arm": (1e-4, 3e-4, 5e-5, 1e-4), "hand": (5e-4, 2e-3, 5e-4, 2e-4)}
"""Of each role: angle in which friction builds up, play, steps and noise of the encoder [rad]. Source: ours,
the orders of harmonic drives, and of spur gears with potentiometers."""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What is wrong in the laboratory and in the drives."""

    latency: float = 0.012  #: from sending a command to the servo's input [s]
    drift: float = 2e-4  #: by how much the clock of the measurements is too fast
    lost: float = 0.03  #: share of commands and measurements that get lost
    play: float = 1.0  #: factor on the play of the gears
    stribeck: float = 1.3  #: friction at rest over that in motion
    viscous: float = 1.0  #: factor on viscous friction, which no torque limit holds back
    asymmetry: float = 0.0  #: share by which friction is larger in one direction and smaller in the other
    load: float = 0.0  #: friction per torque of the belt
    belt: float = 400.0  #: resonance of motor and link on the belt [Hz]
    is_at_link: bool = True  #: whether the encoder is at the link, behind the belt
    zero: tuple[float, float] = (0.0, 0.0)  #: error of the encoder's zero at both ends of a recording [rad]

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Faults":
        """Draw all but latency and loss; source of the ranges: ours, the orders of drives of that size."""
        return cls(
            drift=rng.uniform(-3e-4, 3e-4),
            play=rng.uniform(0.0, 1.5),
            stribeck=rng.uniform(1.0, 1.4),
            viscous=rng.uniform(0.0, 1.0),
            asymmetry=rng.uniform(-0.25, 0.25),
            load=rng.uniform(0.0, 0.1),
            belt=np.exp(rng.uniform(*np.log((45.0, 400.0)))),
            is_at_link=bool(rng.random() < 0.5),
            zero=tuple(rng.uniform(-1e-3, 1e-3, 2)),
        )


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Joints side by side that do not feel each other; one entry a joint."""

    names: tuple[str, ...]  #: of the joints
    stiffness: np.ndarray  #: gain of the servo [N·m/rad]
    damping: np.ndarray  #: gain of the servo and viscous friction together [N·m·s/rad]
    viscous: np.ndarray  #: viscous friction, which no torque limit holds back
    frictionloss: np.ndarray  #: Coulomb friction in motion without load, mean of both directions [N·m]
    armature: np.ndarray  #: inertia of the motor behind its gear [kg·m²]
    faults: Faults  #: what is wrong

    @classmethod
    def drawn(cls, rng: np.random.Generator, names: tuple[str, ...], faults: Faults) -> "Robot":
        """Every parameter up to 40 % off, friction between a half and twice."""
        stiffness, damping, friction, armature = np.array([JOINTS[name][:4] for name in names]).T
        factors = rng.uniform(0.7, 1.4, (3, len(names)))
        return cls(
            names=names,
            stiffness=factors[0] * stiffness,
            damping=factors[1] * damping,
            viscous=faults.viscous * np.array([JOINTS[name][6] for name in names]),
            frictionloss=friction * np.exp(rng.uniform(-np.log(2), np.log(2), len(names))),
            armature=factors[2] * armature,
            faults=faults,
        )

    @property
    def felt_damping(self) -> np.ndarray:
        """Damping that shows in motion [N·m·s/rad]: a pull that is held for a cycle takes some away."""
        return self.damping - self.stiffness * CYCLE * DT / 2

    @property
    def latency(self) -> np.ndarray:
        """From sending a command to its effect [s]: it waits half a cycle of the servo in the mean."""
        return np.full(len(self.names), self.faults.latency + CYCLE * DT / 2)

    def recorded(
        self, rng: np.random.Generator, trajectories: list[Trajectory]
    ) -> tuple[list[Recording], np.ndarray]:
        """What each joint would have recorded of a trajectory of its own, and its friction while it moves.

        A joint takes its column of the trajectory. Of the friction [N·m] it is the 5 % and 95 % quantiles,
        shape (num_joints, 2).
        """
        seconds = max(trajectory.duration for trajectory in trajectories)
        sent = [_sent(rng, each, name) for each, name in zip(trajectories, self.names, strict=True)]
        path, friction = self._path(rng, sent, seconds)
        recordings = []
        for j, (t_cmd, q_cmd) in enumerate(sent):
            step, noise = GEARS[JOINTS[self.names[j]][-1]][2:]
            turns = rng.uniform(0.0, 0.008) + turns_of_a_loop(rng, seconds - 0.05, 0.008, 0.05)
            turns = turns[rng.random(len(turns)) >= self.faults.lost]
            q = np.interp(turns, DT * np.arange(len(path)), path[:, j])
            q = q + np.interp(turns, (0.0, seconds), self.faults.zero)
            q = step * np.round((q + noise * rng.standard_normal(len(q))) / step)
            recordings.append(
                Recording(
                    joints=self.names[j : j + 1],
                    t_cmd=t_cmd,
                    q_cmd=q_cmd,
                    t_meas=turns * (1.0 + self.faults.drift),
                    q=q[:, None],
                )
            )
        return recordings, friction

    def _path(self, rng: np.random.Generator, sent: list, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions at the encoders at every step, (num_steps, num_joints), and `recorded`'s friction."""
        num_steps = int(seconds / DT)
        ticks = DT * CYCLE * np.arange(num_steps // CYCLE + 1)
        inputs = []
        for t_cmd, q_cmd in sent:
            arrives = rng.random(len(t_cmd)) >= self.faults.lost
            arrives[0] = True
            inputs.append(held(t_cmd[arrives] + self.faults.latency, q_cmd[arrives], ticks)[:, 0])
        targets = np.stack(inputs, axis=-1)
        rows = [JOINTS[name] for name in self.names]
        link, limit = (np.array([row[i] for row in rows]) for i in (4, 5))
        slip, half = np.array([GEARS[row[-1]][:2] for row in rows]).T
        half = half * self.faults.play / 2
        motor_inertia, faults = self.armature, self.faults
        belt = (2 * np.pi * faults.belt) ** 2 * motor_inertia * link / (motor_inertia + link)
        belt_damping = 0.1 * np.sqrt(belt * link)  # 5 % of the critical damping
        gain, target = self.damping - self.viscous, targets[0]
        motor, joint, read = target.copy(), target.copy(), target.copy()
        speed, joint_speed, bend, pull = (np.zeros_like(target) for _ in range(4))
        path, levels = np.empty((num_steps, len(rows))), np.empty((num_steps, len(rows)))
        for k in range(num_steps):
            path[k] = read
            if k % CYCLE == 0:
                pull = self.stiffness * (targets[k // CYCLE] - motor)
            torque = np.clip(pull - gain * speed, -limit, limit)
            moved = belt * (motor - joint) + belt_damping * (speed - joint_speed)
            level = self.frictionloss * (1.0 + faults.asymmetry * np.sign(speed)) + faults.load * np.abs(
                moved
            )
            levels[k] = np.where(np.abs(speed) > STRIBECK_SPEED, level, np.nan)
            bristle = level / slip
            bristle_damping = np.sqrt(bristle * motor_inertia)
            fall = np.exp(-((speed / STRIBECK_SPEED) ** 2))
            height = slip * (1.0 + (faults.stribeck - 1.0) * fall)
            slid = np.copysign(height, speed)  # where the bend goes while the speed stays
            bent = slid + (bend - slid) * np.exp(-DT * np.abs(speed) / height)
            friction = bristle * bent + bristle_damping * fall * (bent - bend) / DT
            bend = bent
            speed = speed + DT / motor_inertia * (torque - friction - self.viscous * speed - moved)
            joint_speed = joint_speed + DT / link * moved
            motor, joint = motor + DT * speed, joint + DT * joint_speed
            felt = joint if faults.is_at_link else motor
            read = np.clip(read, felt - half, felt + half)
        return path, np.nanquantile(levels, (0.05, 0.95), axis=0).T


def _sent(rng: np.random.Generator, trajectory: Trajectory, name: str) -> tuple[np.ndarray, np.ndarray]:
    """When the column of a joint's commands was sent [s], and the commands [rad]."""
    turns = turns_of_a_loop(rng, trajectory.duration - DT * CYCLE, 0.008, 0.05)
    t_cmd = np.append(turns + rng.uniform(0.0, DT * CYCLE, len(turns)), trajectory.duration)
    column = trajectory.joints.index(name)
    return t_cmd, trajectory.at(t_cmd)[:, column : column + 1]
