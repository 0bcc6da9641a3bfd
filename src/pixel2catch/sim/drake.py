"""Drake: hydroelastic contact, joints with implicit servos, the convex solver SAP.

Differs from MuJoCo: no restitution, so that models with a restitution are refused. The object is compliant
and all other bodies are rigid; two rigid bodies touch at points.
"""

import importlib
import logging
from functools import cache
from typing import Any, final

import mujoco
import numpy as np

from pixel2catch.errors import DeviceUnavailableError, InvalidValueError
from pixel2catch.installation import needs_extra
from pixel2catch.robots.poses import Pose, pose_of, rotation_matrix
from pixel2catch.sim.engine import EngineCopy, Positions, Speeds, Targets, Wrenches
from pixel2catch.sim.rigid_world import Body, Geom, RigidWorld

MODULUS = 1e5
"""Hydroelastic modulus of the object [Pa]. Source: ours, `benchmarks/engine_calibration.py`: at ten times
this modulus contacts flicker, and a cube slides 30 % less than by Coulomb's law."""

RESOLUTION = 0.01  #: Edge length of the mesh of round shapes [m]. Source: ours, a quarter of an object.
DISSIPATION = 20.0  #: Hunt-Crossley dissipation [s/m]. Source: ours: 4 % of a speed of 1 m/s remain.
POINT_STIFFNESS = 1e5  #: Stiffness of contacts between rigid bodies [N/m]. Source: ours.


@final
class DrakeCopy(EngineCopy):
    """A multibody plant with its scene graph."""

    def __init__(self, world: RigidWorld) -> None:
        if world.restitution > 1e-6:
            raise InvalidValueError(
                f"the object's restitution is {world.restitution:g}; engine 'drake' supports 0 only: give "
                "--restitution 0, or --env.randomization.restitution 0 0."
            )
        drake = load_drake()
        builder = drake.DiagramBuilder()
        self._plant, graph = drake.AddMultibodyPlantSceneGraph(builder, world.timestep)
        self._made = _Builder(self._plant, world)
        self._made.filter(graph)
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._context = self._plant.GetMyMutableContextFromRoot(self._root)
        plant, made = self._plant, self._made
        hinges = [body for body in world.bodies if body.joint is not None]
        self._q = [made.joints[body.number].position_start() for body in hinges]
        self._v = [made.joints[body.number].velocity_start() for body in hinges]
        self._links = [body.number for body in hinges]
        self._qpos = [body.qpos for body in hinges]
        self._dofs = [body.dof for body in hinges]
        self._ctrl = [body.joint.actuator for body in hinges if body.joint is not None]
        free = [(body, made.bodies[body.number]) for body in world.bodies if body.joint is None]
        self._free = [
            (body, made.floating_positions_start(), made.floating_velocities_start_in_v())
            for body, made in free
        ]
        self._aim = np.zeros(2 * len(hinges))
        self._target = plant.get_desired_state_input_port(made.robots)
        self._force = plant.get_applied_generalized_force_input_port()

    def set_state(self, qpos: Positions, qvel: Speeds) -> None:
        plant = self._plant
        q, v = np.zeros(plant.num_positions()), np.zeros(plant.num_velocities())
        q[self._q], v[self._v] = qpos[self._qpos], qvel[self._dofs]
        for body, first, speed in self._free:
            q[first : first + 4] = qpos[body.qpos + 3 : body.qpos + 7]
            q[first + 4 : first + 7] = qpos[body.qpos : body.qpos + 3]
            v[speed : speed + 3] = rotation_matrix(q[first : first + 4]) @ qvel[body.dof + 3 : body.dof + 6]
            v[speed + 3 : speed + 6] = qvel[body.dof : body.dof + 3]
        plant.SetPositionsAndVelocities(self._context, np.concatenate((q, v)))

    def step(self, ctrl: Targets, qfrc: Speeds, xfrc: Wrenches) -> None:
        self._aim[: len(self._ctrl)] = ctrl[self._ctrl]
        self._target.FixValue(self._context, self._aim)
        force = np.zeros(self._plant.num_velocities())
        force[self._v] = qfrc[self._dofs]
        if xfrc[self._links].any():
            raise InvalidValueError("xfrc_applied acts on a link; 'drake' supports free bodies only.")
        positions = self._plant.GetPositions(self._context)
        for body, first, speed in self._free:
            rotation = rotation_matrix(positions[first : first + 4])
            applied, pushed = qfrc[body.dof : body.dof + 6], xfrc[body.number]
            arm = rotation @ body.inertial_pose[:3, 3]
            force[speed : speed + 3] = rotation @ applied[3:] + pushed[3:] + np.cross(arm, pushed[:3])
            force[speed + 3 : speed + 6] = applied[:3] + pushed[:3]
        self._force.FixValue(self._context, force)
        following = self._diagram.EvalUniquePeriodicDiscreteUpdate(self._root)
        self._root.get_mutable_discrete_state().SetFrom(following)

    def read_state(self, qpos: Positions, qvel: Speeds) -> None:
        q, v = self._plant.GetPositions(self._context), self._plant.GetVelocities(self._context)
        qpos[self._qpos], qvel[self._dofs] = q[self._q], v[self._v]
        for body, first, speed in self._free:
            qpos[body.qpos : body.qpos + 3] = q[first + 4 : first + 7]
            quat = q[first : first + 4] / np.linalg.norm(q[first : first + 4])
            qpos[body.qpos + 3 : body.qpos + 7] = quat
            qvel[body.dof : body.dof + 3] = v[speed + 3 : speed + 6]
            qvel[body.dof + 3 : body.dof + 6] = rotation_matrix(quat).T @ v[speed : speed + 3]


@final
class _Builder:
    """Adds bodies, joints and shapes to a plant and finalizes it."""

    def __init__(self, plant: Any, world: RigidWorld) -> None:
        self._plant, self._world, self._drake = plant, world, load_drake()
        self.robots = plant.AddModelInstance("robots")
        self._thrown = plant.AddModelInstance("thrown")
        self.bodies: dict[int, Any] = {0: plant.world_body()}
        self.joints: dict[int, Any] = {}
        self._shapes: list[tuple[int, Geom, Any]] = []  # with the number of their bodies
        plant.mutable_gravity_field().set_gravity_vector(world.gravity)
        for number, geoms in world.fixed.items():
            self._add_shapes(-number, plant.world_body(), geoms, is_soft=False)
        for body in world.bodies:
            self._add_body(body)
        has_weight = {body.has_weight for body in world.bodies if body.joint is not None}
        if len(has_weight) > 1:
            raise InvalidValueError("Drake has no gravity on some links only; use engine 'mujoco'.")
        plant.set_gravity_enabled(self.robots, has_weight == {True})
        plant.set_contact_model(self._drake.ContactModel.kHydroelasticWithFallback)
        plant.SetUseSampledOutputPorts(False)  # a step is then one discrete update
        plant.Finalize()

    def filter(self, graph: Any) -> None:
        """Exclude the pairs of shapes that do not collide in MuJoCo."""
        drake = self._drake
        manager, parents = graph.collision_filter_manager(), {b.number: b.parent for b in self._world.bodies}
        excluded = {frozenset(pair) for pair in self._world.excluded}
        for i, (one, first, first_id) in enumerate(self._shapes):
            for other, second, second_id in self._shapes[:i]:
                meets = (first.contype & second.conaffinity) | (second.contype & first.conaffinity)
                is_neighbour = (parents.get(one) or -one) == other or (parents.get(other) or -other) == one
                if not meets or one == other or is_neighbour or frozenset((one, other)) in excluded:
                    pair = drake.GeometrySet(first_id), drake.GeometrySet(second_id)
                    manager.Apply(drake.CollisionFilterDeclaration().ExcludeBetween(*pair))

    def _add_body(self, body: Body) -> None:
        plant, drake = self._plant, self._drake
        axes, instance = body.inertial_pose[:3, :3], self.robots if body.joint else self._thrown
        i = axes @ np.diag(body.inertia) @ axes.T
        inertia = drake.SpatialInertia.MakeFromCentralInertia(
            body.mass,
            body.inertial_pose[:3, 3],
            drake.RotationalInertia(i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]),
        )
        made = self.bodies[body.number] = plant.AddRigidBody(f"body_{body.number}", instance, inertia)
        self._add_shapes(body.number, made, body.geoms, is_soft=body.joint is None)
        if (joint := body.joint) is None:
            return
        offset = pose_of(joint.pos, np.eye(3))
        places = (("parent", self.bodies[body.parent], body.pose @ offset), ("child", made, offset))
        frames = [
            drake.FixedOffsetFrame(f"{name}_{body.number}", each.body_frame(), self._pose(pose))
            for name, each, pose in places
        ]
        hinge = drake.RevoluteJoint(
            f"joint_{body.number}", *map(plant.AddFrame, frames), joint.axis, *joint.limits, 0.0
        )
        added = self.joints[body.number] = plant.AddJoint(hinge)
        servo = plant.AddJointActuator(f"joint_{body.number}", added, joint.effort_limit)
        servo.set_default_rotor_inertia(joint.armature)
        servo.set_default_gear_ratio(1.0)
        servo.set_controller_gains(drake.PdControllerGains(p=joint.stiffness, d=joint.damping))

    def _add_shapes(self, number: int, body: Any, geoms: tuple[Geom, ...], *, is_soft: bool) -> None:
        drake, world = self._drake, self._world
        for geom in geoms:
            properties = drake.ProximityProperties()
            surface = drake.CoulombFriction(world.friction, world.friction)
            drake.AddContactMaterial(DISSIPATION, POINT_STIFFNESS, surface, properties)
            if is_soft:
                drake.AddCompliantHydroelasticProperties(RESOLUTION, MODULUS, properties)
            else:
                drake.AddRigidHydroelasticProperties(RESOLUTION, properties)
            made = self._plant.RegisterCollisionGeometry(
                body, self._pose(geom.pose), self._shape(geom), f"shape_{len(self._shapes)}", properties
            )
            self._shapes.append((number, geom, made))

    def _shape(self, geom: Geom) -> Any:
        drake, kinds, size = self._drake, mujoco.mjtGeom, geom.size
        make = {
            kinds.mjGEOM_BOX: lambda: drake.Box(*(2.0 * size)),
            kinds.mjGEOM_SPHERE: lambda: drake.Sphere(size[0]),
            kinds.mjGEOM_CAPSULE: lambda: drake.Capsule(size[0], 2.0 * size[1]),
            kinds.mjGEOM_CYLINDER: lambda: drake.Cylinder(size[0], 2.0 * size[1]),
            kinds.mjGEOM_PLANE: drake.HalfSpace,
            kinds.mjGEOM_MESH: lambda: drake.Convex(geom.vertices.T, "hull"),
        }
        return make[geom.type]()

    def _pose(self, matrix: Pose) -> Any:
        rotation = self._drake.RotationMatrix.ProjectToRotationMatrix(matrix[:3, :3])
        return self._drake.RigidTransform(rotation, matrix[:3, 3])


@cache
def load_drake() -> Any:
    """Import Drake."""
    with needs_extra("drake", "engine 'drake' needs Drake, which cannot be imported", DeviceUnavailableError):
        drake = importlib.import_module("pydrake.all")
    logging.getLogger("drake").setLevel(logging.ERROR)  # hides a warning about half-spaces
    return drake
