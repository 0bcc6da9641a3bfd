/** From surface points of the object to its box in the image, and from boxes to pixel features. */

const clamp = (value, lower, upper) => Math.min(Math.max(value, lower), upper);

/** Pixel (u, v) and depth [m] of a point in the world. */
export function project(camera, [x, y, z]) {
  const ray = [x - camera.center[0], y - camera.center[1], z - camera.center[2]];
  const [u, v, depth] = camera.matrix.map((row) => row[0] * ray[0] + row[1] * ray[1] + row[2] * ray[2]);
  return [u / depth, v / depth, depth];
}

/**
 * The smallest box [px] around the part of the visible points that is on the image, as in
 * `camera.boxes.box_of_points`, and the share of points that are visible and on it.
 */
export function detect(camera, points, isVisible) {
  const { width, height } = camera.assumed;
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  let numOnImage = 0;
  let numInView = 0;
  points.forEach((point, i) => {
    if (!isVisible[i]) return;
    const [u, v, depth] = project(camera, point);
    const isInColumns = u >= 0 && u <= width;
    const isInRows = v >= 0 && v <= height;
    if (isInRows) [box[0], box[2]] = [Math.min(box[0], u), Math.max(box[2], u)];
    if (isInColumns) [box[1], box[3]] = [Math.min(box[1], v), Math.max(box[3], v)];
    numOnImage += isInColumns && isInRows;
    numInView += isInColumns && isInRows && depth > 0;
  });
  return { box: numOnImage ? clipped(camera, box) : [0, 0, 0, 0], share: numInView / points.length };
}

function clipped(camera, box) {
  const { width, height } = camera.assumed;
  return box.map((edge, i) => clamp(edge, 0, i % 2 ? height : width));
}

/** The box with an error of each edge [px]; edges that cross are exchanged. */
export function perturbed(camera, box, noise) {
  const [a, b, c, d] = box.map((edge, i) => edge + noise[i]);
  return clipped(camera, [Math.min(a, c), Math.min(b, d), Math.max(a, c), Math.max(b, d)]);
}

/** Every pixel feature of two successive boxes, by name. */
export function pixelFeatures(camera, before, now) {
  const { width, height } = camera.assumed;
  const [old, present] = [before, now].map(([a, b, c, d]) => [(a + c) / 2, (b + d) / 2, c - a, d - b]);
  const [dcx, dcy, dw, dh] = present.map((value, i) => value - old[i]);
  const [cx, cy, w, h] = present;
  return { cx: cx / width, cy: cy / height, w: w / width, h: h / height, dcx, dcy, dw, dh };
}
