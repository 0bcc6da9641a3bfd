/** Observation terms: functions of two successive measurements, named as in `mdp.observations`. */

import { boxFit } from "./box_fit.js";
import { pixelFeatures } from "./camera.js";

const take = (values, columns) => columns.map((column) => values[column]);

const TERMS = {
  pixels: ({ task, contract, before, now }) => {
    const features = pixelFeatures(task.camera, before.boxes[0], now.boxes[0]);
    return contract.pixel_features.map((name) => features[name]);
  },
  palm_pose: ({ now }) => [...now.palm.pos, ...now.palm.quat],
  joint_pos: ({ now, joints }) => take(now.jointPos, joints),
  last_action: ({ now, joints }) => take(now.action, joints),
  joint_pos_target: ({ now, joints }) => take(now.jointPosTarget, joints),
  box_age: ({ now }) => [now.ages[0]],
  box_fit: ({ task, now }) => boxFit(task.box_fit, task.camera.assumed, now.boxes, now.ages),
};

/** Columns of an agent's joints in joint order. */
export function jointColumns(task, agent) {
  const names = task.joints.map((joint) => joint.name);
  return agent.joints.map((name) => names.indexOf(name));
}

/**
 * An agent's observation, in the order of its contract.
 * @param {object[]} history three successive measurements, oldest first
 */
export function observe(task, contract, agent, history) {
  const [oldest, before, now] = history;
  const joints = jointColumns(task, agent);
  return agent.observation.flatMap(([term]) => {
    const [name, when] = term.slice(0, -1).split("[");
    const frame = when === "t" ? { before, now } : { before: oldest, now: before };
    return TERMS[name]({ task, contract, joints, ...frame });
  });
}
