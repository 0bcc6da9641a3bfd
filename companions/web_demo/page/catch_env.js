/** One robot that catches: act, simulate, judge, observe, as `envs.catch_env` does. */

import { detect, perturbed } from "./camera.js";
import { palmPose } from "./kinematics.js";
import { jointColumns, observe } from "./observations.js";

const clamp = (value, lower, upper) => Math.min(Math.max(value, lower), upper);

export class CatchEnv {
  /**
   * @param {object} task of task.json
   * @param {import("./policy.js").Policy} policy
   * @param {import("./world.js").World} world
   * @param {import("./random.js").Random} random noise of sensors and actions
   */
  constructor(task, policy, world, random) {
    Object.assign(this, { task, policy, world, random });
    this.agents = Object.entries(policy.contract.agents).map(([name, agent]) => ({
      name,
      agent,
      columns: jointColumns(task, agent),
    }));
    this.commands = task.joints.map((joint) => policy.contract.commands[joint.name]);
  }

  /** Begin an episode: the object hovers, the robot waits. */
  begin(episode) {
    this.episode = episode;
    this.steps = this.heldSteps = 0;
    this.isReached = this.isSuccess = this.isLost = false;
    this.world.begin(episode);
    const detection = { ...this.look(), stale: 0 };
    this.detections = Array(Math.max(...this.task.sensing.latency_steps) + 1).fill(detection);
    const num = this.task.box_fit.num_boxes;
    const boxes = Array(num).fill(detection.box);
    const ages = Array.from({ length: num }, (_, i) => episode.latency + i);
    const jointPos = this.world.jointPos;
    const first = this.measure(jointPos.map(() => 0), jointPos, boxes, ages);
    this.history = [first, first, first];
  }

  /** Whether the episode is over: held long enough, lost, or out of time. */
  get isEnded() {
    return this.isSuccess || this.isLost || this.steps >= this.task.episode.max_steps;
  }

  /** What each agent sees, by name. */
  observations() {
    const { contract } = this.policy;
    return Object.fromEntries(
      this.agents.map(({ name, agent }) => [name, observe(this.task, contract, agent, this.history)]),
    );
  }

  /** Actions in joint order, in [-1, 1]. */
  decide() {
    const action = new Array(this.task.joints.length).fill(0);
    const observations = this.observations();
    for (const { name, columns } of this.agents) {
      this.policy.act(name, observations[name]).forEach((value, i) => {
        action[columns[i]] = value;
      });
    }
    return action;
  }

  /** One control step with actions in joint order. */
  step(action = this.decide()) {
    const { episode, random, task, world } = this;
    const measured = this.history[2].jointPos;
    const target = this.commands.map(({ anchor, offset, scale, lower, upper }, j) => {
      const disturbed = action[j] + episode.actionBias[j] + task.joints[j].action_noise * random.normal();
      return clamp(anchor * measured[j] + offset + scale * clamp(disturbed, -1, 1), lower, upper);
    });
    world.run(target);
    this.steps += 1;
    this.judge();
    if (this.steps === episode.throw.hoverSteps) world.release(episode.throw.linVel);
    this.sense(action, target);
  }

  /** Whether the palm has reached the object, holds it, or lost it. */
  judge() {
    const { reach, hold_steps: holdSteps, drop_height: dropHeight, drop_x: dropX } = this.task.episode;
    const [palm, object] = [this.world.palmPos, this.world.objectPos];
    const isNear = Math.hypot(...palm.map((value, k) => value - object[k])) < reach;
    this.heldSteps = isNear ? this.heldSteps + 1 : 0;
    this.isReached ||= isNear;
    this.isSuccess ||= this.heldSteps === holdSteps;
    this.isLost ||= !this.isSuccess && (object[2] < dropHeight || object[0] < dropX);
  }

  /** Look and measure after a control step. */
  sense(action, jointPosTarget) {
    const { latency } = this.episode;
    const image = this.look();
    const newest = this.detections[0];
    const detection = image.isSeen ? { ...image, stale: 0 } : { ...newest, stale: newest.stale + 1 };
    this.detections = [detection, ...this.detections.slice(0, -1)];
    const delivered = this.detections[latency];
    let { boxes, ages } = this.history[2];
    ages = ages.map((age) => age + 1);
    if (delivered.stale === 0) {
      boxes = [delivered.box, ...boxes.slice(0, -1)];
      ages = [latency, ...ages.slice(0, -1)];
    }
    this.history = [this.history[1], this.history[2], this.measure(action, jointPosTarget, boxes, ages)];
  }

  /** The box of the object in an image of this moment, with its noise. */
  look() {
    const { task, random } = this;
    const { points, isVisible } = this.world.surfacePoints();
    const { box, share } = detect(task.camera, points, isVisible);
    const noise = box.map(() => task.sensing.corner_noise * random.uniform(-1, 1));
    return { box: perturbed(task.camera, box, noise), isSeen: share >= task.sensing.least_visible };
  }

  /** What the robot measures now, with the noise of its encoders. */
  measure(action, jointPosTarget, boxes, ages) {
    const noise = () => this.task.sensing.joint_noise * this.random.normal();
    const jointPos = this.world.jointPos.map((value, j) => value + this.episode.jointBias[j] + noise());
    return { boxes, ages, jointPos, jointPosTarget, action, palm: palmPose(this.task.palm, jointPos) };
  }
}
