"""MuJoCo once more, built from the rigid bodies that other engines are built from."""

from typing import final

import mujoco
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.robots.poses import quaternion
from pixel2catch.scene.cfg import SOLIMP, contact_solref
from pixel2catch.sim.engine import EngineCopy
from pixel2catch.sim.rigid_world import Body, Geom, RigidWorld


@final
class RebuiltCopy(EngineCopy):
    """What the converter leaves of a model, as a model."""

    def __init__(self, world: RigidWorld) -> None:
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        spec.option.timestep, spec.option.gravity = world.timestep, world.gravity
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        self._spec, self._world, self._made = spec, world, dict[int, mujoco.MjsBody]()
        for number, geoms in world.fixed.items():
            pedestal = spec.worldbody.add_body(name=f"fixed_{number}")
            self._add_geoms(pedestal, geoms)
            if number:
                spec.add_exclude(bodyname1=f"fixed_{number}", bodyname2=f"body_{number}")
        for body in world.bodies:
            self._add_body(body)
        for one, other in world.excluded:
            spec.add_exclude(bodyname1=f"body_{one}", bodyname2=f"body_{other}")
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._numbers = [body.number for body in world.bodies]
        self._ids = [self.model.body(f"body_{number}").id for number in self._numbers]

    def _add_body(self, body: Body) -> None:
        parent = self._made[body.parent] if body.parent else self._spec.worldbody
        made = parent.add_body(
            name=f"body_{body.number}", pos=body.pose[:3, 3], quat=quaternion(body.pose[:3, :3])
        )
        made.explicitinertial, made.mass, made.inertia = True, body.mass, body.inertia
        made.ipos, made.iquat = body.inertial_pose[:3, 3], quaternion(body.inertial_pose[:3, :3])
        made.gravcomp = 0.0 if body.has_weight else 1.0
        self._made[body.number] = made
        if body.joint is None:
            made.add_freejoint()
        else:
            name, joint = f"joint_{body.number}", body.joint
            made.add_joint(
                name=name,
                axis=joint.axis,
                pos=joint.pos,
                range=joint.limits,
                limited=mujoco.mjtLimited.mjLIMITED_TRUE,
                armature=joint.armature,
            )
            self._spec.add_actuator(
                name=name,
                target=name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                gainprm=[joint.stiffness, *[0.0] * 9],
                biasprm=[0.0, -joint.stiffness, -joint.damping, *[0.0] * 7],
                forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
                forcerange=(-joint.effort_limit, joint.effort_limit),
            )
        self._add_geoms(made, body.geoms)

    def _add_geoms(self, body: mujoco.MjsBody, geoms: tuple[Geom, ...]) -> None:
        for i, geom in enumerate(geoms):
            made = body.add_geom(
                type=geom.type,
                pos=geom.pose[:3, 3],
                quat=quaternion(geom.pose[:3, :3]),
                size=geom.size,
                contype=geom.contype,
                conaffinity=geom.conaffinity,
                friction=(self._world.friction, 0.005, 0.0001),
                solref=contact_solref(self._world.restitution, self._world.timestep),
                solimp=SOLIMP,
            )
            if len(geom.vertices):
                made.meshname = f"{body.name}_{i}"
                self._spec.add_mesh(name=made.meshname, uservert=geom.vertices.ravel())

    def set_state(self, qpos: Float[ndarray, " nq"], qvel: Float[ndarray, " nv"]) -> None:
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel

    def step(
        self, ctrl: Float[ndarray, " nu"], qfrc: Float[ndarray, " nv"], xfrc: Float[ndarray, "nbody 6"]
    ) -> None:
        self.data.ctrl[:], self.data.qfrc_applied[:] = ctrl, qfrc
        self.data.xfrc_applied[self._ids] = xfrc[self._numbers]
        mujoco.mj_step(self.model, self.data)

    def read_state(self, qpos: Float[ndarray, " nq"], qvel: Float[ndarray, " nv"]) -> None:
        qpos[:], qvel[:] = self.data.qpos, self.data.qvel
