/** What is drawn for an episode: the object, the robot's deviations, the latency and the throw. */

/** Velocity [m/s] at `pos` of the path that peaks at a height and comes down through `aim`. */
export function launchVelocity(gravity, pos, aim, peak) {
  const rise = Math.sqrt((2 * (peak - pos[2])) / gravity);
  const fall = Math.sqrt((2 * (peak - aim[2])) / gravity);
  return [(aim[0] - pos[0]) / (rise + fall), (aim[1] - pos[1]) / (rise + fall), gravity * rise];
}

/** A throw of the task, as `mdp.throws.sample_throws` draws it. */
export function drawThrow(task, random) {
  const { throws, physics } = task;
  const draw = (name) => random.uniform(...throws[name]);
  const pos = ["release_x", "release_y", "release_z"].map(draw);
  const aim = ["aim_x", "aim_y", "aim_z"].map(draw);
  const peak = Math.max(draw("peak_z"), throws.clearance + Math.max(pos[2], aim[2]));
  return {
    pos,
    aim,
    linVel: launchVelocity(physics.gravity, pos, aim, peak),
    quat: unit([0, 1, 2, 3].map(() => random.normal())),
    hoverSteps: random.integer(...throws.hover_steps),
  };
}

/**
 * An episode; a throw that is given replaces the drawn one.
 * @param {string[]} objects names of what may be thrown
 */
export function drawEpisode(task, random, objects, thrown = null) {
  const { randomization, sensing, joints } = task;
  const range = (name) => random.uniform(...randomization[name]);
  const noise = randomization.initial_joint_noise;
  return {
    object: random.choice(objects),
    latency: random.integer(...sensing.latency_steps),
    massScale: range("mass_scale"),
    restitution: range("restitution"),
    friction: range("friction"),
    stiffnessScale: joints.map((joint) => random.uniform(...joint.stiffness_scale)),
    dampingScale: joints.map((joint) => random.uniform(...joint.damping_scale)),
    actionBias: joints.map((joint) => joint.action_bias * random.normal()),
    jointBias: joints.map(() => sensing.joint_bias * random.normal()),
    jointOffset: joints.map(() => random.uniform(-noise, noise)),
    throw: { ...drawThrow(task, random), ...thrown },
  };
}

function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((value) => value / length);
}
