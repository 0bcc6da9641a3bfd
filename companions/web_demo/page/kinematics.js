/** Pose of the palm from joint positions: a product of matrices that are linear in cos and sin (`robots.chain`). */

/** Position [m] and orientation (w, x, y, z) of the palm, from all joint positions [rad]. */
export function palmPose(palm, jointPos) {
  let pose = null;
  palm.matrices.forEach(([constant, cosine, sine], i) => {
    const angle = jointPos[palm.first + i];
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    const turn = constant.map((row, r) => row.map((value, k) => value + c * cosine[r][k] + s * sine[r][k]));
    pose = pose ? product(pose, turn) : turn;
  });
  return { pos: [pose[0][3], pose[1][3], pose[2][3]], quat: quaternion(pose, palm.side) };
}

function product(a, b) {
  return a.map((row) => b[0].map((_, k) => row[0] * b[0][k] + row[1] * b[1][k] + row[2] * b[2][k] + row[3] * b[3][k]));
}

/** The rotation part as a quaternion, from the row of 4 q qᵀ with the largest diagonal entry. */
function quaternion([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]], side) {
  const products = [
    [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
    [zy - yz, 1 + xx - yy - zz, yx + xy, xz + zx],
    [xz - zx, yx + xy, 1 - xx + yy - zz, zy + yz],
    [yx - xy, xz + zx, zy + yz, 1 - xx - yy + zz],
  ];
  const diagonal = products.map((row, i) => row[i]);
  const largest = diagonal.indexOf(Math.max(...diagonal));
  const quat = products[largest].map((value) => value / (2 * Math.sqrt(diagonal[largest])));
  const alongSide = quat.reduce((sum, value, i) => sum + value * side[i], 0);
  return alongSide < 0 ? quat.map((value) => -value) : quat;
}
