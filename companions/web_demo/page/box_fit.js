/** Path and growth of the box, fitted to the last boxes and carried on to the present (`camera.box_history`). */

const clamp = (value, lower, upper) => Math.min(Math.max(value, lower), upper);

/**
 * Features of the boxes [px], newest first, with their ages [control steps].
 * @param {object} constants of `task.box_fit`
 * @param {object} camera whose axis and focal lengths make pixels into directions
 */
export function boxFit(constants, camera, boxes, ages) {
  const values = boxes.map(([xmin, ymin, xmax, ymax]) => {
    const size = Math.max((xmax - xmin + ymax - ymin) / 2, constants.least_size);
    return [
      ((xmin + xmax) / 2 - camera.cx) / camera.fx,
      ((ymin + ymax) / 2 - camera.cy) / camera.fy,
      Math.log(size / constants.typical_size),
    ];
  });
  const fits = constants.time_constants.map((memory) => fit(constants, camera, values, ages, memory));
  return [...fits.flat(), ...scaled(constants, fits.at(-1)), (ages[0] * 10) / constants.steps_per_second];
}

/** Centre, speed, half acceleration, size, growth and residual now, of a fit with this memory [steps]. */
function fit(constants, camera, values, ages, memory) {
  const weights = softmax(ages.map((age) => -age / memory));
  const mean = (numbers) => numbers.reduce((sum, number, i) => sum + weights[i] * number, 0);
  const times = ages.map((age) => (ages[0] - age) / memory);
  const middle = mean(times);
  const ahead = Math.min(ages[0], constants.longest_extrapolation) / memory - middle;
  // 1, t - a and (t - a)² - b (t - a) - c are orthogonal under the weights: no equations are left to solve.
  const linear = times.map((time) => time - middle);
  const square = linear.map((time) => time * time);
  const slopeOf = (column, basis) =>
    mean(basis.map((each, i) => each * column[i])) / (mean(basis.map((each) => each * each)) + constants.spread_floor);
  const skew = slopeOf(square, linear);
  const variance = mean(square);
  const curved = square.map((each, i) => each - variance - skew * linear[i]);
  const column = (k) => values.map((value) => value[k]);

  const rate = constants.steps_per_second / memory;
  let squaredRest = 0;
  const paths = [0, 1].map((k) => {
    const [average, slope, bend] = [mean(column(k)), slopeOf(column(k), linear), slopeOf(column(k), curved)];
    squaredRest += mean(column(k).map((value, i) => (value - average - slope * linear[i] - bend * curved[i]) ** 2));
    const now = average + slope * ahead + bend * (ahead * ahead - variance - skew * ahead);
    return [now, rate * (slope + bend * (2 * ahead - skew)), rate * rate * bend];
  });
  const growth = slopeOf(column(2), linear);
  const features = [0, 1, 2].flatMap((order) => paths.map((path) => path[order]));
  features.push(mean(column(2)) + growth * ahead, rate * growth);
  features.push((Math.sqrt(squaredRest) * camera.fx) / constants.pixel_noise);
  return features.map((value) => clamp(value, -constants.bound, constants.bound));
}

/** Positions and speeds in sizes of the object instead of angles. */
function scaled(constants, [u, v, du, dv, , , size, growth]) {
  const far = Math.min(Math.exp(-size), constants.most_far);
  return [1, u, v, du, dv, growth].map((value) => clamp(far * value, -constants.bound, constants.bound));
}

function softmax(values) {
  const largest = Math.max(...values);
  const powers = values.map((value) => Math.exp(value - largest));
  const sum = powers.reduce((total, power) => total + power, 0);
  return powers.map((power) => power / sum);
}
