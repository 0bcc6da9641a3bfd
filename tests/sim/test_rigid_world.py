"""What other engines are built from: hand-worked bodies, and MuJoCo rebuilt from them against MuJoCo."""

import itertools
from typing import final

import copies
import mujoco
import numpy as np
import pytest
import torch
from copies import NUM_ENVS, TABLE
from jaxtyping import Float
from numpy import ndarray
from test_agreement import require_equal_catches, start

from pixel2catch.errors import InvalidValueError, NonFiniteError, UnknownNameError
from pixel2catch.robots.poses import quaternion
from pixel2catch.scene.cfg import SOLIMP, contact_solref, restitution_of
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.sim.batch import BatchSimulation
from pixel2catch.sim.engine import MOST_ENVS, EngineCopy, EngineSimulation
from pixel2catch.sim.rigid_world import Body, Geom, RigidWorld, rigid_world, turned_onto
from pixel2catch.sim.simulation import Simulation
from pixel2catch.workcells import workcells

TWO_BALLS = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base"><geom type="box" size="0.1 0.1 0.1" contype="1"/>
      <body name="arm" pos="0 0 1" gravcomp="1">
        <joint name="hinge" axis="0 0 1" range="-2 3" armature="0.01"/>
        <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.2 0.3"/>
        <body name="tip" pos="1 0 0" gravcomp="1">
          <inertial pos="0 0 0" mass="3" diaginertia="0.4 0.5 0.6"/>
          <geom type="box" size="0.1 0.2 0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="hinge" kp="7" kv="2" ctrlrange="-2 3" forcerange="-5 5"/>
  </actuator>
  EXTRA
</mujoco>"""


def world_of(extra: str = "", **replaced: str):
    text = TWO_BALLS.replace("EXTRA", extra)
    for old, new in replaced.items():
        text = text.replace(old, new)
    return rigid_world(mujoco.MjModel.from_xml_string(text))


def test_bodies_that_are_fixed_to_each_other_are_one():
    """1 kg and, 1 m along x, 3 kg: centre at 0.75 m; about y and z 0.75 kg·m² more than the sum."""
    (body,) = world_of().bodies
    assert (body.mass, body.parent, body.has_weight) == (4.0, 0, False)
    np.testing.assert_allclose(body.inertial_pose[:3, 3], (0.75, 0, 0), atol=1e-12)
    np.testing.assert_allclose(np.sort(body.inertia), (0.5, 1.45, 1.65), atol=1e-12)
    assert np.linalg.det(body.inertial_pose[:3, :3]) == pytest.approx(1.0)
    assert body.pose[2, 3] == 1.0
    assert body.joint is not None
    assert (body.joint.stiffness, body.joint.damping, body.joint.effort_limit) == (7.0, 2.0, 5.0)
    assert (body.joint.limits, body.joint.armature) == ((-2.0, 3.0), 0.01)


def test_what_carries_a_robot_belongs_to_it():
    world = world_of()
    assert [len(world.fixed[number]) for number in (0, world.bodies[0].number)] == [0, 1]


@pytest.mark.parametrize(
    ("extra", "replaced", "what"),
    [
        ('<equality><joint joint1="hinge"/></equality>', {}, "neq"),
        ("", {'type="box" size="0.1 0.2': 'type="ellipsoid" size="0.1 0.2'}, "ellipsoids"),
        ("", {'gravcomp="1"': 'gravcomp="0.5"'}, "a gravcomp between 0 and 1"),
        ("", {'armature="0.01"': 'armature="0.01" damping="1"'}, "dof_damping"),
        ("", {'forcerange="-5 5"': ""}, "servos without limits"),
        ("", {'axis="0 0 1"': 'axis="0 0 1" type="slide"'}, "joints other than hinges"),
        ("", {'axis="0 0 1"': 'axis="0 0 1" ref="1"'}, "a reference angle"),
    ],
)
def test_what_has_no_counterpart_is_refused_by_name(extra, replaced, what):
    with pytest.raises(InvalidValueError, match=what):
        world_of(extra, **replaced)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, -1), (0.6, 0, 0.8)])
def test_a_frame_is_turned_onto_an_axis(axis):
    frame = turned_onto(np.array(axis, dtype=float))[:3, :3]
    np.testing.assert_allclose(frame @ (1, 0, 0), axis, atol=1e-12)
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)


@pytest.mark.parametrize("physics_hz", [120.0, 600.0, 1200.0])
def test_restitution_is_read_back_and_never_negative(physics_hz):
    """PhysX takes a negative one, if only by rounding, for a spring: objects then fall through the floor."""
    for restitution, push_out in itertools.product((0.0, 0.25, 0.75), (0.1, 0.2, 0.4)):
        solref = np.array(contact_solref(restitution, 1 / physics_hz, push_out))
        assert restitution_of(solref, 1 / physics_hz) == pytest.approx(restitution, abs=1e-12)
        assert restitution_of(solref, 1 / physics_hz) >= 0.0


@pytest.mark.parametrize("workcell", sorted(workcells()))
def test_every_work_cell_has_all_its_mass(workcell):
    model = build_model(SceneCfg(workcell=workcell))
    model.dof_frictionloss[:] = 0.0
    world = rigid_world(model)
    assert len(world.bodies) == model.nu + 1
    is_moving = model.body_weldid != 0
    assert sum(body.mass for body in world.bodies) == pytest.approx(model.body_mass[is_moving].sum())


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


@pytest.fixture(scope="module")
def both() -> list[Simulation]:
    """MuJoCo, and MuJoCo rebuilt from the rigid bodies, behind the interface of other engines."""
    model = copies.make("batch").model
    return [BatchSimulation(model, NUM_ENVS, 1), EngineSimulation(model, NUM_ENVS, RebuiltCopy)]


def test_the_converter_loses_nothing(both):
    require_equal_catches(both, 40, before=1e-9, after=1e-2)


def test_forces_on_the_object_reach_the_engine(both):
    """A push at the centre of mass, and one on the free joint as air and a shaken table make it."""
    ends = []
    for simulation in both:
        start(simulation)
        simulation.bind("xfrc_applied")[:, copies.BODY] = torch.tensor((0.1, 0.2, 0.3, 1e-5, 0.0, 1e-5))
        simulation.bind("qfrc_applied")[:, TABLE.indices.dofs.start] = 0.2
        simulation.bind("qfrc_applied")[:, 0] = 3.0
        copies.run(simulation, 20)
        ends.append(torch.cat((simulation.bind("qpos"), simulation.bind("qvel")), dim=1).clone())
    torch.testing.assert_close(*ends, atol=1e-8, rtol=0)


def test_an_engine_follows_what_it_says(both):
    assert both[1].can_expand("body_mass")
    assert not both[1].can_expand("dof_damping")
    with pytest.raises(UnknownNameError, match=r"model field of another engine 'dof_damping'.*Valid: geom"):
        both[1].expand("dof_damping")


def test_a_diverged_engine_is_reported(both):
    start(both[1])
    both[1].bind("qvel")[1, 0] = torch.nan
    with pytest.raises(NonFiniteError, match=f"1 of {NUM_ENVS} environments"):
        both[1].check()


def test_too_many_copies_are_refused():
    with pytest.raises(InvalidValueError, match=f"num_envs is {MOST_ENVS + 1}.*at most {MOST_ENVS}"):
        EngineSimulation(copies.make("batch", 1).model, MOST_ENVS + 1, RebuiltCopy)
