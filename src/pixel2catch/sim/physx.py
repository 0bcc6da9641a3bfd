"""PhysX through SAPIEN: reduced coordinates, implicit servos, rigid contacts with an explicit restitution.

Differs from MuJoCo: every surface has the friction and restitution of the thrown object, as PhysX uses the
mean of two surfaces; contacts are rigid.
"""

import importlib
import warnings
from functools import cache
from typing import Any, final

import mujoco
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.errors import DeviceUnavailableError, InvalidValueError
from pixel2catch.installation import needs_extra
from pixel2catch.robots.poses import Pose, quaternion, rotation_matrix
from pixel2catch.sim.engine import EngineCopy, Positions, Speeds, Targets, Wrenches
from pixel2catch.sim.rigid_world import Body, Geom, Joint, RigidWorld, turned_onto

MOST_EXCLUDED = 32  #: Largest number of pairs that do not collide: bits of SAPIEN's collision group.
COLLISION_ID = 1  #: Collision exclusions hold among shapes with this identifier.

ALONG_Z = turned_onto(np.array((0.0, 0.0, 1.0)))
"""Rotation from MuJoCo's capsules, cylinders and planes (axis z) to those of PhysX (axis x)."""

UNTURNED = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_MESH)
"""Shapes with the same axes in both engines."""

CONTACT_OFFSET = 1e-3  #: Distance from a surface at which contacts begin [m]. Source of these four: ours.
BOUNCE_SPEED = 0.1  #: Smallest impact speed with a bounce [m/s]; free fall adds 0.08 in a step at 120 Hz.
POSITION_ITERATIONS, VELOCITY_ITERATIONS = 16, 1  #: Iterations of the solver for positions and for speeds.


@final
class PhysxCopy(EngineCopy):
    """A PhysX scene on the CPU.

    Source of the solver's settings: ours, `experiments/results/2026-11-23-physx-solver`. With substeps (TGS,
    SAPIEN's default; here PGS) a ball leaves an impact with up to three times its spin. With contacts that
    persist from step to step (PCM, SAPIEN's default) some overlaps are detected only at 8 mm.
    """

    def __init__(self, world: RigidWorld) -> None:
        if len(world.excluded) > MOST_EXCLUDED:
            fix = f"PhysX supports at most {MOST_EXCLUDED}: use engine 'mujoco'"
            raise InvalidValueError(f"{len(world.excluded)} pairs of bodies do not collide; {fix}.")
        sapien, physx = load_sapien(), load_sapien().physx
        settings = {"bounce_threshold": BOUNCE_SPEED, "enable_tgs": False, "enable_pcm": False}
        physx.set_scene_config(gravity=world.gravity, **settings)
        self._system = physx.PhysxCpuSystem()
        self._system.timestep = world.timestep
        self._scene = sapien.Scene([self._system])
        shapes = _Shapes(world)
        self._add(shapes.attached(physx.PhysxRigidStaticComponent(), world.fixed[0]))
        self._components = _components(world, shapes)
        for component in self._components.values():
            self._add(component)
        self._free = [(body, self._components[body.number]) for body in world.bodies if body.joint is None]
        jointed = {body.number: (body, body.joint) for body in world.bodies if body.joint is not None}
        articulations = {id(a): a for a in (self._components[number].articulation for number in jointed)}
        self._trees = [_Tree(articulation, jointed) for articulation in articulations.values()]
        trees = [tree.articulation for tree in self._trees]
        for solved in (*(component for _, component in self._free), *trees):
            solved.set_solver_position_iterations(POSITION_ITERATIONS)
            solved.set_solver_velocity_iterations(VELOCITY_ITERATIONS)
            solved.set_sleep_threshold(0.0)

    def set_state(self, qpos: Positions, qvel: Speeds) -> None:
        for tree in self._trees:
            tree.articulation.set_qpos(qpos[tree.qpos])
            tree.articulation.set_qvel(qvel[tree.dofs])
        for body, component in self._free:
            pos, quat = qpos[body.qpos : body.qpos + 3], qpos[body.qpos + 3 : body.qpos + 7]
            rotation = rotation_matrix(quat)
            angular = rotation @ qvel[body.dof + 3 : body.dof + 6]
            arm = rotation @ body.inertial_pose[:3, 3]
            component.entity.set_pose(load_sapien().Pose(pos, quat))
            component.set_linear_velocity(qvel[body.dof : body.dof + 3] + _cross(angular, arm))
            component.set_angular_velocity(angular)

    def step(self, ctrl: Targets, qfrc: Speeds, xfrc: Wrenches) -> None:
        for tree in self._trees:
            for joint, target in zip(tree.joints, ctrl[tree.actuators].tolist(), strict=True):
                joint.set_drive_target(target)
            tree.articulation.set_qf(qfrc[tree.dofs])
        for number in np.flatnonzero(xfrc.any(axis=1)).tolist():
            force = xfrc[number]
            self._components[number].add_force_torque(force[:3], force[3:])
        for body, component in self._free:
            applied = qfrc[body.dof : body.dof + 6]
            if applied.any():
                rotation = np.array(component.entity.pose.to_transformation_matrix())[:3, :3]
                arm = rotation @ body.inertial_pose[:3, 3]
                torque = rotation @ applied[3:] - _cross(arm, applied[:3])
                component.add_force_torque(applied[:3], torque)
        self._system.step()

    def read_state(self, qpos: Positions, qvel: Speeds) -> None:
        for tree in self._trees:
            qpos[tree.qpos] = tree.articulation.get_qpos()
            qvel[tree.dofs] = tree.articulation.get_qvel()
        for body, component in self._free:
            pose = component.entity.pose
            qpos[body.qpos : body.qpos + 3], qpos[body.qpos + 3 : body.qpos + 7] = pose.p, pose.q
            rotation = rotation_matrix(qpos[body.qpos + 3 : body.qpos + 7])
            angular = np.array(component.angular_velocity, dtype=float)
            arm = rotation @ body.inertial_pose[:3, 3]
            qvel[body.dof : body.dof + 3] = component.linear_velocity - _cross(angular, arm)
            qvel[body.dof + 3 : body.dof + 6] = rotation.T @ angular

    def _add(self, component: Any) -> None:
        entity = load_sapien().Entity()
        entity.add_component(component)
        self._scene.add_entity(entity)


@final
class _Tree:
    """A PhysX articulation, and the indices in MuJoCo's arrays of its joints, in PhysX's joint order."""

    def __init__(self, articulation: Any, bodies: dict[int, tuple[Body, Joint]]) -> None:
        self.articulation, self.joints = articulation, articulation.get_active_joints()
        members = [bodies[int(joint.name)] for joint in self.joints]
        self.qpos = [body.qpos for body, _ in members]
        self.dofs = [body.dof for body, _ in members]
        self.actuators = [joint.actuator for _, joint in members]


def _components(world: RigidWorld, shapes: "_Shapes") -> dict[int, Any]:
    physx = load_sapien().physx
    roots = {}
    for number in world.fixed.keys() - {0}:
        roots[number] = shapes.attached(physx.PhysxArticulationLinkComponent(None), world.fixed[number])
        roots[number].joint.type = "fixed"
    components = {}
    for body in world.bodies:
        if body.joint is None:
            component = physx.PhysxRigidDynamicComponent()
        else:
            component = physx.PhysxArticulationLinkComponent(
                components.get(body.parent, roots.get(body.number))
            )
            _set_joint(component.joint, body, body.joint)
        shapes.attached(component, body.geoms, body.number)
        component.mass = body.mass
        component.cmass_local_pose = _pose(body.inertial_pose)
        component.inertia = body.inertia
        component.disable_gravity = not body.has_weight
        component.linear_damping = component.angular_damping = 0.0
        components[body.number] = component
    return {-number: root for number, root in roots.items()} | components


def _set_joint(made: Any, body: Body, joint: Joint) -> None:
    made.name, made.type = str(body.number), "revolute_unwrapped"
    frame = turned_onto(joint.axis)
    frame[:3, 3] = joint.pos
    made.pose_in_child, made.pose_in_parent = _pose(frame), _pose(body.pose @ frame)
    made.limits = np.array([joint.limits])
    made.armature = np.array([joint.armature])
    made.friction = 0.0
    made.set_drive_properties(joint.stiffness, joint.damping, joint.effort_limit)


@final
class _Shapes:
    """Creates shapes of one material, with the collision filters of their bodies."""

    def __init__(self, world: RigidWorld) -> None:
        physx = load_sapien().physx
        self._material = physx.PhysxMaterial(world.friction, world.friction, world.restitution)
        self._excluded = world.excluded

    def attached(self, component: Any, geoms: tuple[Geom, ...], number: int = 0) -> Any:
        """Attach shapes to a component; the number of its body selects its collision exclusions."""
        for geom in geoms:
            shape = self._shape(geom)
            excluded = sum(1 << i for i, pair in enumerate(self._excluded) if number in pair)
            shape.set_collision_groups([geom.contype, geom.conaffinity, excluded, COLLISION_ID])
            shape.contact_offset, shape.rest_offset = CONTACT_OFFSET, 0.0
            component.attach(shape)
        return component

    def _shape(self, geom: Geom) -> Any:
        physx, kinds, size, material = load_sapien().physx, mujoco.mjtGeom, geom.size, self._material
        make = {
            kinds.mjGEOM_BOX: lambda: physx.PhysxCollisionShapeBox(size, material),
            kinds.mjGEOM_SPHERE: lambda: physx.PhysxCollisionShapeSphere(size[0], material),
            kinds.mjGEOM_CAPSULE: lambda: physx.PhysxCollisionShapeCapsule(*size[:2], material),
            kinds.mjGEOM_CYLINDER: lambda: physx.PhysxCollisionShapeCylinder(*size[:2], material),
            kinds.mjGEOM_PLANE: lambda: physx.PhysxCollisionShapePlane(material),
            kinds.mjGEOM_MESH: lambda: physx.PhysxCollisionShapeConvexMesh(
                geom.vertices, np.ones(3), material
            ),
        }
        shape = make[geom.type]()
        shape.set_local_pose(_pose(geom.pose if geom.type in UNTURNED else geom.pose @ ALONG_Z))
        return shape


def _pose(matrix: Pose) -> Any:
    return load_sapien().Pose(matrix[:3, 3], quaternion(matrix[:3, :3]))


def _cross(first: Float[ndarray, "3"], second: Float[ndarray, "3"]) -> Float[ndarray, "3"]:
    """Return the cross product; NumPy takes twenty times as long for one pair."""
    result = np.empty(3)
    mujoco.mju_cross(result, np.asarray(first, dtype=float), np.asarray(second, dtype=float))
    return result


@cache
def load_sapien() -> Any:
    """Import SAPIEN."""
    with (
        needs_extra("physx", "engine 'physx' needs SAPIEN, which cannot be imported", DeviceUnavailableError),
        warnings.catch_warnings(action="ignore"),  # a missing graphics driver; nothing is rendered
    ):
        return importlib.import_module("sapien")
