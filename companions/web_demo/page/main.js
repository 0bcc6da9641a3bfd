/** The page: throws of the mouse and automatic ones, in real time, and how many were caught. */

import { Aiming } from "./aiming.js";
import { CatchEnv } from "./catch_env.js";
import { automaticThrows, loadDemo } from "./demo.js";
import { drawEpisode } from "./episode.js";
import loadMujoco from "./lib/mujoco.js";
import { Random } from "./random.js";
import { poses, View } from "./view.js";

const STEPS_AFTER_CATCH = 40; // control steps to look at a catch
const STEPS_AFTER_LOSS = 20;
const MOST_STEPS_BEHIND = 4; // control steps that a slow machine makes up for at once
const FAST_THROWS = 50;
const HINT = "Drag the object up towards the robot and let go (Shift: throw from elsewhere; turn the view to aim sideways).";

const element = (id) => document.querySelector(`#${id}`);

/** Load everything and begin. */
export async function start() {
  const mujoco = await loadMujoco();
  const read = async (name) => {
    const response = await fetch(name);
    if (!response.ok) throw new Error(`${name}: ${response.status} ${response.statusText}`);
    return response.arrayBuffer();
  };
  const page = new Page(await loadDemo(read, mujoco));
  window.pixel2catch = page; // for scripts
  page.run();
}

class Page {
  constructor(demo) {
    this.demo = demo;
    this.random = new Random(Date.now());
    this.env = new CatchEnv(demo.task, demo.policy, demo.world, this.random);
    this.view = new View(element("picture"), element("camera"), demo.task.camera);
    this.aiming = new Aiming(this.view, demo.task, {
      thrown: (velocity) => this.throwObject(velocity),
      moved: (position) => this.prepare(position),
    });
    this.counts = { yours: [0, 0], automatics: [0, 0] };
    this.isAutomatic = false;
    this.connectControls();
    this.prepare();
  }

  connectControls() {
    const { seen, unseen } = this.demo.task.objects;
    element("object").append(
      new Option("any", ""),
      ...[...seen, ...unseen].map((name) => new Option(name.replaceAll("_", " "), name)),
    );
    element("object").addEventListener("change", () => this.isWaiting && this.prepare());
    element("automatic").addEventListener("click", () => this.setAutomatic(!this.isAutomatic));
    element("measure").addEventListener("click", () => this.measure(FAST_THROWS, Date.now()));
    this.setEnabled(true);
  }

  setEnabled(isEnabled) {
    for (const id of ["object", "automatic", "measure"]) element(id).disabled = !isEnabled;
  }

  /** Throw one after the other, or wait for the mouse. */
  setAutomatic(isAutomatic) {
    this.isAutomatic = isAutomatic;
    element("automatic").setAttribute("aria-pressed", isAutomatic);
    if (this.isWaiting) this.prepare();
  }

  /** What may be thrown. */
  get objects() {
    const { value } = element("object");
    return value ? [value] : this.demo.task.objects.seen;
  }

  /** Begin an episode; the mouse's waits until it throws, from a position if one is given [m]. */
  prepare(position = null) {
    const again = position && { ...this.episode, throw: { ...this.episode.throw, pos: position } };
    this.episode = again ?? drawEpisode(this.demo.task, this.random, this.objects);
    this.env.begin(this.episode);
    this.isWaiting = !this.isAutomatic;
    this.lateSteps = 0;
    this.isCounted = false;
    this.before = this.now = poses(this.demo.world.data);
    this.view.show(this.episode.object, this.demo.world.model);
    if (!position) this.aiming.open(this.isWaiting ? this.episode.throw : null);
    this.say(this.isWaiting ? HINT : `automatic throw of ${this.episode.object.replaceAll("_", " ")}`);
  }

  /** Throw with the mouse's velocity [m/s]. */
  throwObject(velocity) {
    this.episode.throw.linVel = velocity;
    this.isWaiting = false;
    this.aiming.open(null);
    this.say("");
  }

  /** One control step, and what follows from it. */
  step() {
    this.env.step();
    this.before = this.now;
    this.now = poses(this.demo.world.data);
    if (!this.env.isEnded) return;
    if (!this.isCounted) this.count(this.isAutomatic ? "automatics" : "yours", this.env.isSuccess);
    this.lateSteps += 1;
    if (this.lateSteps > (this.env.isSuccess ? STEPS_AFTER_CATCH : STEPS_AFTER_LOSS)) this.prepare();
  }

  count(kind, isSuccess) {
    this.isCounted = true;
    this.counts[kind][0] += 1;
    this.counts[kind][1] += isSuccess;
    const [throws, caught] = this.counts[kind];
    const texts = [throws, caught, `${((100 * caught) / throws).toFixed(0)} %`];
    texts.forEach((text, i) => {
      element(kind).cells[i + 1].textContent = text;
    });
    this.say(isSuccess ? "caught" : "missed", isSuccess ? "caught" : "missed");
  }

  /** Automatic throws as fast as the machine can, without pictures; returns how each ended. */
  async measure(count, seed) {
    this.isPaused = true;
    this.setEnabled(false);
    this.aiming.open(null);
    const results = [];
    for (const result of automaticThrows(this.demo, count, seed)) {
      results.push(result);
      this.count("automatics", result.isSuccess);
      this.say(`${results.length} of ${count} throws`);
      await new Promise((resolve) => setTimeout(resolve));
    }
    this.isPaused = false;
    this.setEnabled(true);
    this.prepare();
    this.say(`caught ${results.filter((each) => each.isSuccess).length} of ${count} automatic throws`);
    return results;
  }

  say(text, kind = "") {
    element("hint").textContent = text;
    element("hint").className = kind;
    element("hint").hidden = !text;
  }

  /** Draw and simulate in real time, for as long as the page is open. */
  run() {
    const period = 1000 * this.demo.task.physics.control_dt;
    let [last, behind] = [performance.now(), 0];
    const frame = (time) => {
      behind = Math.min(behind + time - last, MOST_STEPS_BEHIND * period);
      last = time;
      if (this.isWaiting || this.isPaused) behind = 0;
      for (; behind >= period && !this.isWaiting; behind -= period) this.step();
      if (!this.isPaused) {
        this.view.draw(this.before, this.now, this.isWaiting ? 1 : behind / period);
        this.drawBox();
      }
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  /** The box that the policy is told of, over the camera's picture. */
  drawBox() {
    const [xmin, ymin, xmax, ymax] = this.env.history[2].boxes[0];
    const { width, height } = this.demo.task.camera.true;
    const percent = (value, whole) => `${(100 * value) / whole}%`;
    Object.assign(element("box").style, {
      left: percent(xmin, width),
      top: percent(ymin, height),
      width: percent(xmax - xmin, width),
      height: percent(ymax - ymin, height),
    });
  }
}
