"""Robot, object and camera in simulation."""

from functools import partial
from itertools import accumulate
from types import SimpleNamespace

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.batches import Counts, Flags, Joints, PointFlags, Points, Quaternions, Scalars, Vectors
from pixel2catch.camera.pinhole import is_unoccluded
from pixel2catch.envs.actuators import JointActuators
from pixel2catch.envs.episode import StepExtremes
from pixel2catch.mdp.control_step import Columns, Privileged, merged, take
from pixel2catch.mdp.randomization import EpisodeParameters
from pixel2catch.mdp.tensors import write
from pixel2catch.mdp.terminations import reach_of
from pixel2catch.mdp.throws import Throw
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.cfg import contact_solref
from pixel2catch.scene.constants import GRAVITY
from pixel2catch.scene.objects import OBJECTS, surface_points
from pixel2catch.scene.scene import ObjectTable, SceneCfg, build_model, contact_sensors, object_table
from pixel2catch.sim.factory import make_simulation
from pixel2catch.sim.simulation import Places, Simulation
from pixel2catch.workcells import find_workcell

OCCLUDER_GROUPS = (0, 3)  #: Geom groups that can hide the object: table and floor, robot.

NUM_SURFACE_POINTS = 64  #: Points of the object. Source: ours, see `benchmarks/box_error.py`.

MASS_POWER = {
    **dict.fromkeys(("body_mass", "body_subtreemass", "body_inertia", "dof_M0"), 1),
    **dict.fromkeys(("body_invweight0", "dof_invweight0"), -1),
}
"""Exponent by field: a change of the object's mass by a factor changes the field by factor ** exponent."""

OCCLUDER_MARGIN = 1e-3  #: Added to the size of every occluder [m]. Source: ours; float32 errs by less.

DIVERGED_SPEED = 1e4
"""Speed of a joint or object beyond which the simulation counts as diverged [rad/s, m/s]. Source: ours."""

FIELDS = (
    *("qpos", "qvel", "qacc_warmstart", "xfrc_applied", "qfrc_applied", "qfrc_constraint"),
    *("actuator_force", "sensordata", "site_xpos", "site_xmat", "geom_xpos"),
)
"""Live tensors of the simulation that are bound once."""


class Occluders:
    """Bounding balls of the robot's geoms and of the objects, and the table's top."""

    def __init__(self, model: mujoco.MjModel, surface: Float[Tensor, "num_objects num_points 3"]) -> None:
        """Read the geoms of a model; points on every object are about its centre [m]."""
        surroundings = [model.geom(name).id for name in ("floor", "table")]
        is_ball = np.isin(model.geom_group, OCCLUDER_GROUPS)
        is_ball[surroundings] = False
        radius = np.where(is_ball, model.geom_rbound + OCCLUDER_MARGIN, -np.inf)
        self._radius = torch.tensor(radius).to(surface)
        self._object_radius = torch.linalg.vector_norm(surface, dim=-1).amax(dim=-1)
        table = model.geom("table")
        self._top = float(table.pos[2] + table.size[2]) + OCCLUDER_MARGIN

    def may_hide(self, origin: Places, center: Vectors, object_id: Counts, geom_pos: Points) -> Flags:
        """Return whether anything may hide a part of an object from a camera; False is certain.

        Rays to points of the object's ball stay within its radius of the ray to its centre. Camera, centre
        and geoms are in the world frame [m].
        """
        radius = self._object_radius[object_id]
        way = (center - origin).T[..., None]
        offset = (geom_pos - origin.unsqueeze(-2)).movedim(-1, 0).contiguous()
        share = (offset * way).sum(dim=0) / way.square().sum(dim=0)
        apart = (offset - share.clamp(0.0, 1.0) * way).square().sum(dim=0).sqrt()
        is_near = apart < self._radius + radius[:, None]
        is_low = torch.minimum(center[:, 2] - radius, origin[..., 2]) < self._top
        return is_near.any(dim=-1) | is_low


class CatchWorld:
    """`num_envs` robots, each with an object that hovers, flies and lands.

    Values read from it are float32. Call `simulation.forward` after `reset` and `release`.
    """

    def __init__(
        self,
        scene: SceneCfg,
        dynamics: JointDynamics | None,
        *,
        num_envs: int,
        device: str,
        limits_commands: bool = True,
    ) -> None:
        """Build the model and its copies; joints without `dynamics` are nominal. See `JointActuators`."""
        workcell = find_workcell(scene.workcell)
        dynamics = JointDynamics.of(workcell.joints, dynamics)
        dynamics.require(workcell.joints)
        self._num_joints = len(workcell.joints)
        model = build_model(scene, armature=dict(zip(dynamics.joints, dynamics.armature, strict=True)))
        model.dof_frictionloss[: self._num_joints] = 0.0  # the servos apply it
        self.simulation: Simulation = make_simulation(model, num_envs, device, scene.engine)
        self.objects: ObjectTable = object_table(scene)
        self.num_envs, self.device, self._scene = num_envs, self.simulation.device, scene
        tensor = partial(torch.tensor, dtype=self.simulation.dtype, device=self.device)
        palms = [palm.spec for palm in workcell.palms]
        self._palms = [(model.site(palm.site).id, tensor(palm.normal)) for palm in palms]
        self._tips = [model.site(finger.tip).id for palm in palms for finger in palm.fingers]
        self.geometry = WorkcellGeometry(workcell, self.simulation.device)
        sensors = [*contact_sensors(workcell)]  # each has the number of contacts and the least distance
        first = int(model.sensor(sensors[0]).adr[0])
        self._contacts = slice(first, first + 2 * len(sensors))
        self._anything, self._num_robots = sensors.index("object_any"), len(workcell.robots)
        self.arms = merged(workcell.of_role("arm"))
        starts = accumulate((1 + len(palm.fingers) for palm in palms[:-1]), initial=0)
        #: Columns of the palms in `Privileged.is_touching`, where each is followed by its fingers.
        self.palms: Columns = tuple(slice(start, start + 1) for start in starts)
        self._fields = SimpleNamespace(**{name: self.simulation.bind(name) for name in FIELDS})
        joints = workcell.joints
        self._actuators = JointActuators(self.simulation, dynamics, joints, limits_commands=limits_commands)
        ranges = [(joint.home, joint.lower, joint.upper) for joint in joints]
        self._home, self._lower, self._upper = tensor(ranges).T.contiguous()
        self._table = {
            name: torch.as_tensor(rows).to(self.device)
            for name, rows in self.objects.fields.items()
            if self.simulation.can_expand(name)
        }
        self._model = {
            name: self.simulation.expand(name)
            for name in (*self._table, "body_mass", "geom_solref", "geom_friction")
        }
        thrown = [OBJECTS[name].scaled(scene.object_scale) for name in self.objects.names]
        points = np.stack([surface_points(spec, NUM_SURFACE_POINTS) for spec in thrown])
        self._surface = torch.as_tensor(points).to(self.device, torch.float32)
        self._occluders = Occluders(model, self._surface)
        self._reach = torch.tensor([reach_of(spec.radius) for spec in thrown], device=self.device)
        first = self.objects.indices.dofs.start
        self._linear = slice(first, first + 3)
        self._object_id = torch.zeros(num_envs, dtype=torch.long, device=self.device)
        #: Environments that `run` advances; the CPU leaves others as they are. None: all.
        self.is_active: Flags | None = None

    @property
    def joint_pos(self) -> Joints:
        """Return the true joint positions [rad]."""
        return _snapshot(self._fields.qpos[:, : self._num_joints])

    @property
    def live(self) -> tuple[Tensor, ...]:
        """Return the tensors of the state besides what `reset` sets, one row per environment."""
        fields = self._fields
        state = (fields.qpos, fields.qvel, fields.qacc_warmstart, fields.xfrc_applied)
        return (*state, *self._actuators.live)

    def is_diverged(self) -> Flags:
        """Return where a speed is not a number, or beyond `DIVERGED_SPEED`."""
        return ~(self._fields.qvel.abs() < DIVERGED_SPEED).all(dim=-1)

    def reset(self, mask: Flags, parameters: EpisodeParameters, throw: Throw) -> None:
        """Set the masked robots to their start, with new dynamics and a new hovering object."""
        self._set_object(mask, parameters)
        joint_pos = torch.clamp(self._home + parameters.joint_offset, self._lower, self._upper)
        fields = self._fields
        start = torch.cat((joint_pos, throw.pos.to(joint_pos), throw.quat.to(joint_pos)), dim=-1)
        write(mask, start, fields.qpos)
        self._actuators.reset(mask, joint_pos, parameters)
        fields.qvel.masked_fill_(mask[:, None], 0.0)
        fields.qacc_warmstart.masked_fill_(mask[:, None], 0.0)
        weight = GRAVITY * self._model["body_mass"][:, self.objects.indices.body]
        write(mask, weight, fields.xfrc_applied[:, self.objects.indices.body, 2])

    def release(self, mask: Flags, throw: Throw) -> None:
        """Throw the masked objects.

        Half a step of gravity is added to the speed, because the integrator moves by the speed at the end of
        a step: throws then land alike at any physics rate.
        """
        velocity = self._fields.qvel[:, self._num_joints :]
        start = torch.cat((throw.lin_vel, throw.ang_vel), dim=-1).to(velocity)
        start[:, 2] += 0.5 * GRAVITY * self._scene.physics_dt
        write(mask, start, velocity)
        self._fields.xfrc_applied[:, self.objects.indices.body, 2].masked_fill_(mask, 0.0)

    def run(
        self,
        joint_pos_target: Joints,
        drag: Scalars | None = None,
        side_force: Vectors | None = None,
        num_steps: int | None = None,
    ) -> StepExtremes:
        """Simulate a control step, or some physics steps; commands ramp linearly to the target [rad].

        Drag and side force of the air are accelerations of the object over the square of its speed [1/m].
        """
        num_steps = num_steps or self._scene.decimation
        increment = self._actuators.increment(joint_pos_target, num_steps)
        peaks = None
        for _ in range(num_steps):
            if drag is not None:
                self._slow_object(drag, side_force)
            self._actuators.advance(increment)
            self.simulation.step(self.is_active)
            seen = self._extremes()
            peaks = seen if peaks is None else peaks.merged(seen)
        assert peaks is not None
        return peaks

    def _slow_object(self, drag: Scalars, side_force: Vectors | None) -> None:
        """Apply the force of the air to the object; tumbling is neglected."""
        force = self._fields.qfrc_applied[:, self._linear]
        velocity = self._fields.qvel[:, self._linear]
        speed = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
        mass = self._model["body_mass"][:, self.objects.indices.body]
        acceleration = -drag.to(force)[:, None] * speed * velocity
        if side_force is not None:
            acceleration = acceleration + side_force.to(force) * speed.square()
        force.copy_(mass[:, None] * acceleration)

    def quiet_log(self) -> StepExtremes:
        """Return the log of a control step without contacts."""
        return StepExtremes(*map(torch.zeros_like, self._extremes()))

    def privileged(self, log: StepExtremes) -> Privileged:
        """Return the true state, with the contacts of a control step from its log."""
        fields = self._fields
        normals = [fields.site_xmat[:, palm].view(-1, 3, 3) @ normal for palm, normal in self._palms]
        return Privileged(
            palm_pos=torch.stack([fields.site_xpos[:, palm] for palm, _ in self._palms], dim=1).float(),
            palm_normal=torch.stack(normals, dim=1).float(),
            fingertip_pos=torch.stack([fields.site_xpos[:, tip] for tip in self._tips], dim=1).float(),
            object_pos=_snapshot(fields.qpos[:, self.objects.indices.qpos])[:, :3],
            object_lin_vel=_snapshot(fields.qvel[:, self._linear]),
            object_reach=self._reach[self._object_id],
            is_touching=log.is_touching,
            is_robot_on_table=log.is_robot_on_table,
            is_self_contact=log.is_self_contact,
            is_robot_contact=log.is_robot_contact,
            joint_vel=_snapshot(fields.qvel[:, : self._num_joints]),
            torque_share=(fields.actuator_force.abs() / self._actuators.limits.effort_limit).float(),
        )

    def surface_points(self, origin: Places) -> tuple[Points, PointFlags]:
        """Return surface points of the object, world frame [m], and which are seen from a place [m]."""
        pos, quat = _snapshot(self._fields.qpos[:, self.objects.indices.qpos]).split((3, 4), dim=-1)
        turned = rotation_matrix(quat).transpose(1, 2)
        points = torch.baddbmm(pos[:, None], self._surface[self._object_id], turned)
        may_hide = None
        if self.device.type == "cpu":  # a GPU casts all rays at once
            geoms = _snapshot(self._fields.geom_xpos)
            may_hide = self._occluders.may_hide(origin, pos, self._object_id, geoms)
        directions = (points - origin.unsqueeze(-2)).to(self.simulation.dtype)
        hit = self.simulation.ray(origin.to(directions), directions, OCCLUDER_GROUPS, may_hide)
        return points, is_unoccluded(hit)

    def _set_object(self, mask: Tensor, parameters: EpisodeParameters) -> None:
        write(mask, parameters.object_id, self._object_id)
        rows = self.objects.indices.rows
        for name, table in self._table.items():
            value = table[parameters.object_id]
            factor = parameters.mass_scale.to(value.dtype) ** MASS_POWER.get(name, 0)
            scaled = value * factor.view(-1, *(1,) * (value.ndim - 1)) if name in MASS_POWER else value
            self._write(mask, name, rows(name), scaled)
        solref = contact_solref(parameters.restitution, self._scene.physics_dt, parameters.push_out)
        solref = torch.stack(solref, dim=-1)
        self._write(mask, "geom_solref", rows("geom_solref"), solref[:, None])
        friction = self._model["geom_friction"][:, rows("geom_friction"), 0]
        write(mask, parameters.friction[:, None].expand_as(friction), friction)

    def _write(self, mask: Tensor, name: str, rows: slice, value: Tensor) -> None:
        field = self._model[name][:, rows]
        write(mask, value.to(field.dtype).expand_as(field), field)

    def _extremes(self) -> StepExtremes:
        """Return the log of a physics step, in new memory and in SI units."""
        fields, sensors = self._fields, self._fields.sensordata[:, self._contacts]
        anything, num_robots, is_found = self._anything, self._num_robots, sensors[:, ::2] > 0
        of_object, of_robots = is_found[:, : anything + 1], is_found[:, anything + 1 :]
        torque_share = fields.actuator_force.abs() / self._actuators.limits.effort_limit
        object_force = fields.qfrc_constraint[:, self._linear].square().sum(dim=-1).sqrt()
        return StepExtremes(
            is_touching=of_object[:, :anything],
            is_robot_on_table=of_robots[:, :num_robots].any(dim=-1),
            is_self_contact=of_robots[:, num_robots:].any(dim=-1),
            is_robot_contact=of_robots[:, 2 * num_robots :].any(dim=-1),
            penetration=(-sensors[:, 2 * anything + 1]).clamp(min=0.0).float(),
            joint_speed=take(fields.qvel, self.arms).abs().amax(dim=-1).float(),
            torque_share=torque_share.amax(dim=-1).float(),
            object_force=object_force.float(),
        )


def _snapshot(live: Tensor) -> Tensor:
    """Return a float32 copy; a cast alone would be a view of a float32 simulation."""
    return live.to(torch.float32, copy=True)


def rotation_matrix(quat: Quaternions) -> Float[Tensor, "num_envs 3 3"]:
    """Return the rotations of unit quaternions (w, x, y, z)."""
    w, x, y, z = quat.unbind(dim=-1)
    rows = (
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return torch.stack(rows, dim=-1).view(-1, 3, 3)
