/** Robot and object in MuJoCo: what `CatchEnv` acts on and reads from (`envs.world`, `envs.actuators`). */

const OBJECT = "object";
const clamp = (value, lower, upper) => Math.min(Math.max(value, lower), upper);

export class World {
  /**
   * @param {object} mujoco the WebAssembly module
   * @param {object} task of task.json
   * @param {(name: string) => string} sceneXml MJCF of the scene with an object
   */
  constructor(mujoco, task, sceneXml) {
    this.mujoco = mujoco;
    this.task = task;
    this.sceneXml = sceneXml;
    this.copies = new Map();
    this.numJoints = task.joints.length;
    this.groups = Array.from({ length: 6 }, (_, group) => Number(task.physics.occluder_groups.includes(group)));
  }

  get model() {
    return this.copy.model;
  }

  get data() {
    return this.copy.data;
  }

  /** Put the robot at its start, with new dynamics, and let the object hover. */
  begin(episode) {
    const { task, mujoco, numJoints } = this;
    this.copy = this.copyOf(episode.object);
    this.object = episode.object;
    const { model, data } = this;
    mujoco.mj_resetData(model, data);
    this.setObject(episode);
    task.joints.forEach((joint, j) => {
      data.qpos[j] = clamp(joint.home + episode.jointOffset[j], joint.lower, joint.upper);
    });
    data.qpos.set([...episode.throw.pos, ...episode.throw.quat], numJoints);
    this.command = Float64Array.from(data.qpos.subarray(0, numJoints));
    this.gains = task.joints.map((joint, j) => ({
      stiffness: joint.stiffness * episode.stiffnessScale[j],
      damping: joint.damping * episode.dampingScale[j],
    }));
    const [gainWidth, biasWidth] = [model.actuator_gainprm, model.actuator_biasprm].map((a) => a.length / model.nu);
    this.gains.forEach(({ stiffness, damping }, j) => {
      model.actuator_gainprm[gainWidth * j] = stiffness;
      model.actuator_biasprm.set([-stiffness, -damping], biasWidth * j + 1);
    });
    data.xfrc_applied[6 * this.copy.body + 2] = task.physics.gravity * model.body_mass[this.copy.body];
    mujoco.mj_forward(model, data);
  }

  /** Let the object fly; half a step of gravity is made up for, as the speed changes before the position. */
  release(linVel) {
    const { model, data, numJoints } = this;
    const lift = 0.5 * this.task.physics.gravity * model.opt.timestep;
    data.qvel.set([linVel[0], linVel[1], linVel[2] + lift, 0, 0, 0], numJoints);
    data.xfrc_applied[6 * this.copy.body + 2] = 0;
  }

  /** Simulate one control step; the commands ramp linearly to the target [rad]. */
  run(jointPosTarget) {
    const { decimation } = this.task.physics;
    const increment = jointPosTarget.map((target, j) => (target - this.command[j]) / decimation);
    for (let i = 0; i < decimation; i++) {
      increment.forEach((change, j) => {
        this.command[j] += change;
      });
      this.drive();
      this.mujoco.mj_step(this.model, this.data);
    }
    this.mujoco.mj_kinematics(this.model, this.data);
  }

  /**
   * Surface points of the object [m], and whether neither robot nor table hides them from the camera.
   * Ray by ray: `mj_multiRay` of MuJoCo 3.14 misses some that graze a finger.
   */
  surfacePoints() {
    const { data, task, mujoco } = this;
    const position = data.xpos.slice(3 * this.copy.body, 3 * this.copy.body + 3);
    const axes = data.xmat.slice(9 * this.copy.body, 9 * this.copy.body + 9);
    const points = task.objects.points[this.object].map(([x, y, z]) =>
      [0, 1, 2].map((k) => position[k] + axes[3 * k] * x + axes[3 * k + 1] * y + axes[3 * k + 2] * z),
    );
    const { center } = task.camera;
    const isVisible = points.map((point) => {
      const ray = point.map((value, k) => value - center[k]);
      const distance = mujoco.mj_ray(this.model, data, center, ray, this.groups, true, -1, null, null);
      return distance < 0 || distance >= 1;
    });
    return { points, isVisible };
  }

  get jointPos() {
    return Array.from(this.data.qpos.subarray(0, this.numJoints));
  }

  get objectPos() {
    return Array.from(this.data.xpos.subarray(3 * this.copy.body, 3 * this.copy.body + 3));
  }

  get palmPos() {
    return Array.from(this.data.site_xpos.subarray(3 * this.copy.palm, 3 * this.copy.palm + 3));
  }

  /** Set what drives the joints in the next physics step: see `envs.actuators.Servos`. */
  drive() {
    const { data, task, gains, command } = this;
    const { qpos, qvel, ctrl, qfrc_applied: friction } = data;
    const { speed_margin: speedMargin, effort_margin: effortMargin, friction_speed: frictionSpeed } = task.physics;
    task.joints.forEach((joint, j) => {
      const { stiffness, damping } = gains[j];
      const lead = (speedMargin * joint.velocity_limit * damping) / stiffness;
      const near = clamp(command[j], qpos[j] - lead, qpos[j] + lead);
      const balance = qpos[j] + (damping * qvel[j]) / stiffness;
      const reach = (effortMargin * joint.effort_limit) / stiffness;
      ctrl[j] = clamp(near, balance - reach, balance + reach);
      friction[j] = -joint.frictionloss * Math.tanh(qvel[j] / frictionSpeed);
    });
  }

  /** The compiled scene with an object, its state, and the object's nominal numbers. */
  copyOf(object) {
    if (!this.copies.has(object)) {
      const model = this.mujoco.MjModel.from_xml_string(this.sceneXml(object));
      model.opt.timestep = this.task.physics.control_dt / this.task.physics.decimation;
      model.dof_frictionloss.fill(0, 0, this.numJoints); // the servos apply it
      const body = model.body(OBJECT).id;
      const dof = this.numJoints;
      const fields = Object.entries(this.task.physics.mass_power).map(([name, power]) => {
        const [first, count, width] = name.startsWith("dof_")
          ? [dof, 6, model[name].length / model.nv]
          : [body, 1, model[name].length / model.nbody];
        const start = first * width;
        return { name, power, start, values: Array.from(model[name].subarray(start, start + count * width)) };
      });
      const geoms = [...model.geom_bodyid].flatMap((each, geom) => (each === body ? [geom] : []));
      const palm = model.site(this.task.palm.site).id;
      this.copies.set(object, { model, data: new this.mujoco.MjData(model), body, palm, geoms, fields });
    }
    return this.copies.get(object);
  }

  /** Mass, restitution and friction of the object. */
  setObject({ massScale, restitution, friction }) {
    const { model, copy } = this;
    for (const { name, power, start, values } of copy.fields) {
      model[name].set(values.map((value) => value * massScale ** power), start);
    }
    const { push_out: pushOut } = this.task.physics;
    const dt = model.opt.timestep;
    for (const geom of copy.geoms) {
      model.geom_solref.set([-pushOut / dt ** 2, -(1 - 0.5 * pushOut + restitution) / dt], 2 * geom);
      model.geom_friction[3 * geom] = friction;
    }
  }
}
