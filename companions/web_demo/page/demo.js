/** Everything that the page and its test run: the task, the policy and a robot that catches. */

import { CatchEnv } from "./catch_env.js";
import { drawEpisode } from "./episode.js";
import { Policy, readTensors } from "./policy.js";
import { Random } from "./random.js";
import { World } from "./world.js";

/**
 * Read what the export wrote.
 * @param {(name: string) => Promise<ArrayBuffer>} read content of a file of the page's folder
 * @param {object} mujoco the WebAssembly module
 */
export async function loadDemo(read, mujoco) {
  const text = async (name) => new TextDecoder().decode(await read(name));
  const json = async (name) => JSON.parse(await text(name));
  const [task, contract, tensors] = await Promise.all([
    json("task.json"),
    json("policy/policy.json"),
    read("policy/policy.safetensors").then(readTensors),
  ]);
  const names = [...task.objects.seen, ...task.objects.unseen];
  const scenes = new Map(
    await Promise.all(names.map(async (name) => [name, await text(`scenes/${name}.xml`)])),
  );
  const world = new World(mujoco, task, (name) => scenes.get(name));
  return { task, policy: new Policy(contract, tensors, task.input_clip), world };
}

/** Throws of the task one after the other, drawn from a seed: how each ended. */
export function* automaticThrows({ task, policy, world }, count, seed, objects = task.objects.seen) {
  const random = new Random(seed);
  const env = new CatchEnv(task, policy, world, random);
  for (let i = 0; i < count; i++) {
    const episode = drawEpisode(task, random, objects);
    env.begin(episode);
    while (!env.isEnded) env.step();
    yield { object: episode.object, isReached: env.isReached, isSuccess: env.isSuccess, steps: env.steps };
  }
}
