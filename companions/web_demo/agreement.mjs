/**
 * Compare the page's code with recorded throws of the Python code: node web_demo_agreement.mjs FOLDER FILE
 *
 * "forced" puts robot and object into the recorded state after every step, so that only sensing, observation,
 * network and commands are compared; "free" simulates, until the hand first touched the object.
 * Differences are in the network's units: observations by their standard deviations, at least 1 for large numbers.
 */
import { readFile } from "node:fs/promises";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [folder, file] = process.argv.slice(2).map((name) => path.resolve(name));
const load = (name) => import(pathToFileURL(path.join(folder, name)));
const { loadDemo } = await load("demo.js");
const { CatchEnv } = await load("catch_env.js");
const { Random } = await load("random.js");
const mujoco = await (await load("lib/mujoco.js")).default();
const read = async (name) => new Uint8Array(await readFile(path.join(folder, name))).buffer;
const { task, policy, world } = await loadDemo(read, mujoco);
const { episodes, steps } = JSON.parse(await readFile(file, "utf8"));
Object.assign(task.sensing, { corner_noise: 0, joint_noise: 0 });
for (const joint of task.joints) joint.action_noise = 0;

/** What was drawn, by the page's names: mass_scale is massScale. */
function renamed(value) {
  if (Array.isArray(value) || typeof value !== "object") return value;
  const name = (key) => key.replace(/_(.)/g, (_, letter) => letter.toUpperCase());
  return Object.fromEntries(Object.entries(value).map(([key, each]) => [name(key), renamed(each)]));
}

const simulate = world.run.bind(world);
const result = { forced: {}, free: {}, num_steps_free: 0 };

function note(differences, name, found, expected, scale = null) {
  const sizes = found.map((value, i) => Math.abs(value - expected[i]) / (scale ? Math.max(scale[i], Math.abs(expected[i])) : 1));
  differences[name] = Math.max(differences[name] ?? 0, ...sizes.map((size) => (Number.isFinite(size) ? size : Infinity)));
}

for (const [kind, differences] of [["forced", result.forced], ["free", result.free]]) {
  episodes.forEach((episode, i) => {
    const env = new CatchEnv(task, policy, world, new Random(0));
    let recorded = null;
    world.run = (target) => {
      note(differences, "target", target, recorded.target[i]);
      if (kind === "free") return simulate(target);
      world.data.qpos.set(recorded.qpos[i]);
      mujoco.mj_kinematics(world.model, world.data);
    };
    env.begin(renamed(episode));
    for (recorded of steps) {
      if (kind === "free" && recorded.is_touched[i]) break;
      const observations = env.observations();
      for (const { name, columns } of env.agents) {
        const std = policy.tensors[`agents.${name}.input_std`].data;
        note(differences, "observation", observations[name], recorded.observations[name][i], std);
        const action = env.decide();
        note(differences, "action", columns.map((column) => action[column]), recorded.actions[name][i]);
      }
      env.step();
      result.num_steps_free += kind === "free";
    }
  });
}
console.log(JSON.stringify(result));
