// The page on which a person labels a video. The program behind it keeps the labels and saves every change.

import { ask, connect, part } from "./link.js";

const NEAR = 9; // distance at which a corner is taken [px of the page]
const LEAST_SIDE = 2; // of a box [px of the image]
const ZOOMS = [1, 2, 4, 8];
const COLORS = { held: "#e0a030", flight: "#3f9bff", "near the hand": "#22b455" };

const canvas = part("image"), context = canvas.getContext("2d");
const line = part("line"), lineContext = line.getContext("2d");

let state = null, picture = null;
let phase = "held"; // of what is labelled next
let drag = null; // a box that is being dragged: the corner that stays, and the one that moves
let zoom = 1, center = null; // of the part of the image that is shown

function lose() {
  part("video").textContent = "no connection to the program that serves this page";
}

function hear(told) {
  part("problem").textContent = told.error ?? "";
  if (told.error) return;
  const moved = state?.image !== told.image;
  state = told;
  if (moved) drag = null;
  if (state.label) phase = state.label.phase;
  if (moved && zoom > 1) center = middle(box() ?? state.suggested) ?? center;
  const { label, labelled } = state;
  document.title = `${state.image} - ${state.video}`;
  part("video").textContent = state.video;
  if (document.activeElement !== part("object")) part("object").value = state.object;
  part("saved").textContent = `${labelled.length} labelled, saved in ${state.file}`;
  const place = `image ${state.image} of ${state.first} to ${state.last}, ${state.time.toFixed(3)} s: `;
  part("place").textContent = place + (label ? `${label.phase}, ${words(label.box)}` : "not labelled");
  for (const button of part("phases").children)
    button.setAttribute("aria-pressed", String(button.dataset.phase === phase));
  draw();
}

const words = (edges) => (edges ? edges.map((edge) => edge.toFixed(1)).join("  ") : "not visible");
const middle = (edges) => edges && [(edges[0] + edges[2]) / 2, (edges[1] + edges[3]) / 2];
const box = () => state?.label?.box ?? null;

async function show(jpeg) {
  const next = await createImageBitmap(jpeg).catch(() => null);
  if (!next) return;
  picture?.close();
  picture = next;
  draw();
}

// the part of the image that is shown: left, top, width, height [px of the image]
function view() {
  const [width, height] = state.size, [w, h] = [width / zoom, height / zoom];
  const [u, v] = center ?? [width / 2, height / 2];
  return [Math.min(Math.max(u - w / 2, 0), width - w), Math.min(Math.max(v - h / 2, 0), height - h), w, h];
}

function draw() {
  if (!state) return;
  const [width, height] = state.size, scale = Math.max(1, Math.round(1280 / width));
  if (canvas.width !== width * scale) Object.assign(canvas, { width: width * scale, height: height * scale });
  context.imageSmoothingEnabled = zoom < 4;
  if (picture) context.drawImage(picture, ...view(), 0, 0, canvas.width, canvas.height);
  const color = COLORS[phase];
  if (drag) outline(edges(drag), color, []);
  else if (box()) outline(box(), color, []);
  else if (state.suggested && !state.label) outline(state.suggested, "#fff", [8, 6]);
  drawLine();
}

function outline([xmin, ymin, xmax, ymax], color, dashes) {
  const [left, top, w] = view(), k = canvas.width / w;
  for (const [style, width] of [["#000a", 4], [color, 2]]) {
    context.strokeStyle = style;
    context.lineWidth = width;
    context.setLineDash(dashes);
    context.strokeRect((xmin - left) * k, (ymin - top) * k, (xmax - xmin) * k, (ymax - ymin) * k);
  }
}

function drawLine() {
  line.width = line.clientWidth;
  const step = line.width / (state.last - state.first + 1), at = (image) => (image - state.first) * step;
  for (const [image, kind, visible] of state.labelled) {
    lineContext.fillStyle = COLORS[kind];
    if (visible) lineContext.fillRect(at(image), 5, Math.max(step - 0.5, 1), 21);
    else lineContext.fillRect(at(image), 20, Math.max(step - 0.5, 1), 6);
  }
  lineContext.fillStyle = "#b3141b";
  lineContext.fillRect(at(state.image) + step / 2 - 1, 0, 2, 26);
}

const edges = ([x, y, u, v]) => [Math.min(x, u), Math.min(y, v), Math.max(x, u), Math.max(y, v)];

function place(event) {
  const frame = canvas.getBoundingClientRect(), [left, top, w, h] = view();
  const k = Math.min(frame.width / canvas.width, frame.height / canvas.height); // `object-fit` centres it
  const x = (event.clientX - frame.left - (frame.width - k * canvas.width) / 2) / (k * canvas.width);
  const y = (event.clientY - frame.top - (frame.height - k * canvas.height) / 2) / (k * canvas.height);
  const inside = (value, end) => Math.min(Math.max(value, 0), end);
  return [inside(left + x * w, state.size[0]), inside(top + y * h, state.size[1])];
}

canvas.addEventListener("pointerdown", (event) => {
  if (!state) return;
  canvas.setPointerCapture(event.pointerId);
  const [x, y] = place(event), shown = box() ?? state.suggested;
  const near = (NEAR * view()[2]) / canvas.getBoundingClientRect().width;
  drag = [x, y, x, y];
  if (!shown) return;
  for (const [i, j] of [[0, 1], [2, 1], [0, 3], [2, 3]])
    if (Math.hypot(shown[i] - x, shown[j] - y) < near) drag = [shown[2 - i], shown[4 - j], x, y];
});
canvas.addEventListener("pointermove", (event) => {
  if (!drag) return;
  drag = [...drag.slice(0, 2), ...place(event)];
  draw();
});
canvas.addEventListener("pointerup", (event) => {
  if (!drag) return;
  const dragged = edges([...drag.slice(0, 2), ...place(event)]);
  drag = null;
  if (Math.min(dragged[2] - dragged[0], dragged[3] - dragged[1]) >= LEAST_SIDE) label(dragged);
  draw();
});
canvas.addEventListener("pointercancel", () => (drag = null));

line.addEventListener("pointerdown", (event) => {
  const share = event.offsetX / line.clientWidth;
  go(Math.floor(state.first + share * (state.last - state.first + 1)));
});

function label(edges) {
  const rounded = edges && edges.map((edge) => Math.round(10 * edge) / 10);
  ask({ do: "label", image: state.image, phase, box: rounded });
}

const go = (image) => ask({ do: "show", image });

function choose(kind) {
  phase = kind;
  if (state.label) label(state.label.box);
  else hear(state);
}

function move(dx, dy, corner) {
  const shown = box() ?? state.suggested;
  if (!shown) return;
  const [x, y, u, v] = shown;
  label(corner ? [x, y, u + dx, v + dy] : [x + dx, y + dy, u + dx, v + dy]);
}

const actions = {
  take: () => state.suggested && label(state.suggested),
  hidden: () => label(null),
  forget: () => ask({ do: "forget", image: state.image }),
  fill: () => ask({ do: "fill", image: state.image }),
  zoom: () => {
    zoom = ZOOMS[(ZOOMS.indexOf(zoom) + 1) % ZOOMS.length];
    center = middle(box() ?? state.suggested) ?? center;
    draw();
  },
};
const KEYS = { Enter: "take", n: "hidden", x: "forget", Delete: "forget", i: "fill", z: "zoom" };
const PHASES = { h: "held", f: "flight", m: "near the hand" };
const MOVES = { w: [0, -1], a: [-1, 0], s: [0, 1], d: [1, 0] };

for (const button of part("phases").children) button.onclick = () => choose(button.dataset.phase);
for (const [name, act] of Object.entries(actions)) part(name).onclick = act;
part("object").onchange = (event) => ask({ do: "name", object: event.target.value });

addEventListener("keydown", (event) => {
  if (!state || event.target === part("object") || event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key, far = event.shiftKey;
  if (key === "ArrowRight") go(state.image + (far ? 10 : 1));
  else if (key === "ArrowLeft") go(state.image - (far ? 10 : 1));
  else if (key in MOVES) move(...MOVES[key], far);
  else if (key in PHASES) choose(PHASES[key]);
  else if (key in KEYS && !(key === "Enter" && event.target.tagName === "BUTTON")) actions[KEYS[key]]();
  else return;
  event.preventDefault();
});
addEventListener("resize", draw);

connect("/label", show, hear, lose);
