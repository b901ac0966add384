// Quaternions w, x, y, z and vectors as plain arrays: the twins of human.py's functions, one at a time instead of rows.

export function quatMul(a, b) { // human.quat_mul
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

export function quatConj(q) { // human.quat_conj
  return [q[0], -q[1], -q[2], -q[3]];
}

export function cross(a, b) { // human.cross
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

export function quatRotate(q, v) { // human.quat_rotate
  const u = [q[1], q[2], q[3]];
  const t = cross(u, v).map((x) => 2 * x);
  const s = cross(u, t);
  return [v[0] + q[0] * t[0] + s[0], v[1] + q[0] * t[1] + s[1], v[2] + q[0] * t[2] + s[2]];
}

export function quatMatrix([w, x, y, z]) { // human.quat_matrix, rows one after the other
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

export function quatAbout(axis, angle) { // human.quat_about
  const q = [Math.cos(angle / 2), 0, 0, 0];
  q[1 + axis] = Math.sin(angle / 2);
  return q;
}

export function quatSlerp(a, b, t) { // human.quat_slerp
  let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = dot < 0 ? -1 : 1;
  dot = Math.min(Math.abs(dot), 1);
  const theta = Math.acos(dot);
  const small = theta < 1e-6; // sin θ/θ → 1
  const s = small ? 1 : Math.sin(theta);
  const wa = small ? 1 - t : Math.sin((1 - t) * theta) / s;
  const wb = (small ? t : Math.sin(t * theta) / s) * sign;
  const q = a.map((x, i) => wa * x + wb * b[i]);
  const norm = Math.hypot(...q);
  return q.map((x) => x / norm);
}

export function heading([w, x, y, z]) { // human.heading: of the body's left axis, so that it cannot flip
  return Math.atan2(-2 * (x * y - w * z), 1 - 2 * (x * x + z * z));
}

export const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
