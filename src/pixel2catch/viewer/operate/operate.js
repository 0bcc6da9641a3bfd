// The operator's page. A browser is no safety device: if the switch may not be held, it is released, here and in
// the program that serves this page.

import { connect, part, send } from "./link.js";

const BEAT_MS = 50; // time between two messages while the switch is held
const HEARD_MS = 500; // time after which a stop should be confirmed
const ERROR_MS = 6000, PROMPT_MS = 3000; // for how long an error and a box that was sent are shown
const LEAST_SIDE = 3; // of a box [px]
const LONGEST_MS = 100; // what a bar of full length is: images must not be older

const canvas = part("image"), context = canvas.getContext("2d");

let state = null; // newest state from the program
let picture = null; // the camera's newest image
let drag = null, prompt = null; // a box that is being dragged, and the one sent last, in image pixels
let stopped = null; // the requested stop: its time, and the number of confirmed stops before it
const holding = new Set(); // what holds the switch: pointers and keys

// Each request has the time of the newest state, so that the program can refuse requests that were delayed.
const request = (wanted) => send({ ...wanted, heard: state?.time });

function setText(id, text) {
  const element = part(id);
  if (element.textContent !== text) element.textContent = text;
}

function lose() {
  letGo();
  state = null;
  document.body.dataset.tone = "absent";
  setText("headline", "no connection to the program that serves this page");
  setText("advice", "Stop with the hardware emergency stop. The page connects again by itself.");
}

function receive(message) {
  if (message.error) {
    letGo(); // it may be the cause of the error
    return showError(message.error);
  }
  state = message;
  document.title = state.title;
  document.body.dataset.tone = state.tone;
  setText("robot", state.robot);
  setText("headline", state.headline);
  setText("advice", state.advice.join(" "));
  setText("refusal", errorText || state.refusal);
  setText("message", state.message);
  setText("sight", state.sight && `${state.sight}.`);
  part("trial").hidden = !state.is_asking;
  part("switch").hidden = !state.has_switch;
  part("other-switch").hidden = state.has_switch;
  setText("switch-state", state.is_held ? "held" : "let go");
  showTwin(state.twin);
  showLatency(state.latency_ms);
  hearStop();
  draw();
}

let errorText = ""; // error of the program or of this page
function showError(text) {
  errorText = text;
  setText("refusal", text);
  setTimeout(() => (errorText = errorText === text ? "" : errorText), ERROR_MS);
}

// the camera's image, and the box that one drags on it

async function show(jpeg) {
  const next = await createImageBitmap(jpeg).catch(() => null); // one that is damaged shows nothing
  if (!next) return;
  picture?.close();
  picture = next;
  draw();
}

function draw() {
  if (!state) return;
  const [width, height] = state.size;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  context.fillStyle = "#222";
  context.fillRect(0, 0, width, height);
  if (state.has_image && picture) context.drawImage(picture, 0, 0, width, height);
  else write("no image from the camera", width / 2, height / 2);
  if (state.box) outline(state.box, ...(state.is_seen ? ["#22e052", []] : ["#ff9b30", [3, 5]])); // or was seen
  const pointed = drag ?? prompt;
  if (pointed) outline(edges(pointed), "#ffd21f", [8, 5]);
}

function write(text, x, y) {
  context.fillStyle = "#fff";
  context.font = "24px system-ui, sans-serif";
  context.textAlign = "center";
  context.fillText(text, x, y);
}

function outline([xmin, ymin, xmax, ymax], color, dashes) {
  for (const [style, width] of [["#000", 4], [color, 2]]) {
    context.strokeStyle = style;
    context.lineWidth = width;
    context.setLineDash(dashes);
    context.strokeRect(xmin, ymin, xmax - xmin, ymax - ymin);
  }
}

const edges = ([x, y, u, v]) => [Math.min(x, u), Math.min(y, v), Math.max(x, u), Math.max(y, v)];

function place(event) {
  const frame = canvas.getBoundingClientRect();
  const x = ((event.clientX - frame.left) / frame.width) * canvas.width;
  const y = ((event.clientY - frame.top) / frame.height) * canvas.height;
  return [Math.min(Math.max(x, 0), canvas.width), Math.min(Math.max(y, 0), canvas.height)];
}

canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  drag = [...place(event), ...place(event)];
});
canvas.addEventListener("pointermove", (event) => {
  if (!drag) return;
  drag = [...drag.slice(0, 2), ...place(event)];
  draw();
});
canvas.addEventListener("pointerup", () => {
  if (!drag) return;
  [prompt, drag] = [drag, null];
  const sent = prompt, box = edges(prompt).map((edge) => Math.round(10 * edge) / 10);
  if (Math.min(box[2] - box[0], box[3] - box[1]) >= LEAST_SIDE) request({ do: "point", box });
  else showError("Drag a box round the object, from corner to corner.");
  setTimeout(() => (prompt = prompt === sent ? null : prompt), PROMPT_MS);
  draw();
});
canvas.addEventListener("pointercancel", () => (drag = null));

// the switch

function hold(source) {
  if (!state?.has_switch || holding.has(source)) return;
  if (holding.size === 0) request({ do: "press" });
  holding.add(source);
  part("hold").setAttribute("aria-pressed", "true");
}

function letGo(source) {
  if (source === undefined) holding.clear();
  else if (!holding.delete(source)) return;
  if (holding.size) return;
  request({ do: "let_go" });
  part("hold").setAttribute("aria-pressed", "false");
}

setInterval(() => holding.size && request({ do: "hold" }), BEAT_MS);

part("hold").addEventListener("pointerdown", (event) => {
  if (event.button !== 0) return;
  part("hold").releasePointerCapture(event.pointerId); // else a finger that slides off would not leave
  hold(event.pointerId);
});
for (const name of ["pointerup", "pointerleave", "pointercancel"]) {
  part("hold").addEventListener(name, (event) => letGo(event.pointerId));
}
part("hold").addEventListener("contextmenu", (event) => event.preventDefault());
addEventListener("blur", () => letGo());
addEventListener("pagehide", () => letGo());
document.addEventListener("visibilitychange", () => document.hidden && letGo());

// stop, arm, keys

function stop() {
  letGo();
  request({ do: "stop" });
  stopped = { at: performance.now(), before: state?.num_heard ?? 0 };
  part("heard").classList.remove("unheard");
  setText("heard", "STOP was sent.");
  setTimeout(hearStop, HEARD_MS);
}

function hearStop() {
  if (!stopped) {
    if (state?.is_active) setText("heard", "");
    return;
  }
  const since = Math.round(performance.now() - stopped.at);
  const isHeard = state !== null && state.num_heard > stopped.before;
  if (!isHeard && since < HEARD_MS) return;
  part("heard").classList.toggle("unheard", !isHeard);
  setText("heard", isHeard ? `STOP was confirmed after ${since} ms.` : "STOP was not confirmed: use the emergency stop!");
  if (isHeard) stopped = null;
}

function stopByKey(event) {
  if (event.key !== "Escape" && event.key !== " ") return false;
  event.preventDefault(); // no button is pressed by space
  if (!event.repeat) stop();
  return true;
}

function press(event) {
  if (stopByKey(event) || event.repeat || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key.toLowerCase() === "h") hold(event.code);
  if (event.key.toLowerCase() === "a") request({ do: "arm" });
}

function release(event) {
  if (event.key === " ") event.preventDefault();
  letGo(event.code); // the key itself, whatever it is called now: with shift, or in another layout
}

addEventListener("keydown", press, true);
addEventListener("keyup", release, true);
part("stop").addEventListener("pointerdown", stop);
part("stop").addEventListener("click", (event) => event.detail === 0 && stop()); // by a screen reader
part("arm").addEventListener("click", () => request({ do: "arm" }));

// the twin, latencies

function showTwin(twin) {
  part("twin").hidden = !twin;
  if (!twin) return;
  setText("throw", twin.throw);
  setText("result", twin.result);
  setText("twin-trouble", twin.trouble);
  part("catch").disabled = twin.is_busy;
  if (document.activeElement !== part("seed")) part("seed").value = twin.seed;
}

part("catch").addEventListener("click", () => request({ do: "catch" }));
part("seed").addEventListener("change", () => request({ do: "seed", seed: part("seed").valueAsNumber }));
for (const button of document.querySelectorAll("[data-do]")) {
  button.addEventListener("click", () => request({ do: button.dataset.do }));
}

function showLatency(latency) {
  const entries = Object.entries(latency);
  part("latency").hidden = entries.length === 0;
  part("bars").replaceChildren(
    ...entries.map(([name, value]) => {
      const row = Object.assign(document.createElement("div"), { className: "bar" });
      const [label, length, text] = ["span", "i", "span"].map((kind) => document.createElement(kind));
      label.textContent = name;
      length.style.width = `${Math.min(100, (100 * value) / LONGEST_MS)}%`;
      text.textContent = `${value.toFixed(1)} ms`;
      row.append(label, length, text);
      return row;
    }),
  );
}

connect(show, receive, lose);
