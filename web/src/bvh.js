// What the character did as BVH.  Twins of retarget.write_bvh and mocap.bvh.write, one string instead of a file.

import { quatConj, quatMatrix, quatMul, quatRotate, subtract } from './human.js';

const toFile = ([x, y, z]) => [y, z, x]; // left, up, forward: y up, z forward, x left
const row = (values) => values.map((v) => (Math.abs(v) < 5e-10 ? 0 : v).toFixed(9)).join(' ');
const DEGREES = 180 / Math.PI;

// mocap.bvh._euler_degrees for "ZXY": R = Rz Rx Ry
export function eulerZXY(q) {
  const r = quatMatrix(q);
  const x = Math.asin(Math.min(Math.max(r[7], -1), 1));
  if (Math.abs(r[7]) > 1 - 1e-12) return [Math.atan2(r[3], r[0]) * DEGREES, x * DEGREES, 0];
  return [Math.atan2(-r[1], r[4]) * DEGREES, x * DEGREES, Math.atan2(-r[6], r[8]) * DEGREES];
}

// frames : [{ xpos, xquat }] of all bodies; table, parents and ipos of the character
export function writeBvh({ bodies, root }, parents, ipos, frames, rate) {
  const vec = (array, b) => Array.from(array.subarray(3 * b, 3 * b + 3));
  const quat = (array, b) => Array.from(array.subarray(4 * b, 4 * b + 4));
  const inTree = (b) => { while (b && b !== root) b = parents[b]; return b === root; };
  const tree = bodies.map((_, b) => b).filter((b) => b && inTree(b));
  const children = (b) => tree.filter((c) => c !== root && parents[c] === b);
  const offset = new Map(tree.map((b) => [b, [0, 0, 0]]));
  for (const b of tree) {
    if (b === root) continue;
    for (const f of frames) {
      const o = quatRotate(quatConj(quat(f.xquat, parents[b])), subtract(vec(f.xpos, b), vec(f.xpos, parents[b])));
      offset.set(b, offset.get(b).map((x, k) => x + o[k] / frames.length));
    }
  }
  const cm = (v) => row(toFile(v).map((x) => 100 * x));
  const lines = ['HIERARCHY'];
  const order = [];
  const open = (b, depth) => {
    const tab = '\t'.repeat(depth);
    const position = b === root ? 'Xposition Yposition Zposition ' : '';
    order.push(b);
    lines.push(`${tab}${b === root ? 'ROOT' : 'JOINT'} ${bodies[b]}`, `${tab}{`, `${tab}\tOFFSET ${cm(offset.get(b))}`,
      `${tab}\tCHANNELS ${b === root ? 6 : 3} ${position}Zrotation Xrotation Yrotation`);
    for (const c of children(b)) open(c, depth + 1);
    if (!children(b).length) {
      const end = cm(vec(ipos, b).map((x) => 2 * x)); // as far beyond the centre of mass as that from the origin
      lines.push(`${tab}\tEnd Site`, `${tab}\t{`, `${tab}\t\tOFFSET ${end}`, `${tab}\t}`);
    }
    lines.push(`${tab}}`);
  };
  open(root, 0);
  lines.push('MOTION', `Frames: ${frames.length}`, `Frame Time: ${1 / rate}`);
  const before = new Map();
  for (const f of frames) {
    const values = toFile(vec(f.xpos, root)).map((x) => 100 * x);
    for (const b of order) {
      let q = quat(f.xquat, b);
      if (b !== root) q = quatMul(quatConj(quat(f.xquat, parents[b])), q);
      let angles = eulerZXY([q[0], ...toFile(q.slice(1))]);
      const last = before.get(b);
      if (last) angles = angles.map((a, k) => a - 360 * Math.round((a - last[k]) / 360)); // no jumps by a full turn
      before.set(b, angles);
      values.push(...angles);
    }
    lines.push(row(values));
  }
  return `${lines.join('\n')}\n`;
}
