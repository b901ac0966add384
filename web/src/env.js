// What the policy sees [Reda23 Eqs. 2 to 4]: twins of env.HeadingFrame, observe_sim, observe_user, observe.

import { heading } from './human.js';

export class HeadingFrame { // env.HeadingFrame: on the floor below the root, turned with the root's heading
  constructor(qpos) {
    const yaw = heading([qpos[3], qpos[4], qpos[5], qpos[6]]);
    [this.c, this.s] = [Math.cos(yaw), Math.sin(yaw)];
    [this.x, this.y] = [qpos[0], qpos[1]];
  }

  turn(x, y, z, out, at, step = 1) {
    out[at] = this.c * x + this.s * y;
    out[at + step] = this.c * y - this.s * x;
    out[at + 2 * step] = z;
  }

  place(x, y, z, out, at) {
    this.turn(x - this.x, y - this.y, z, out, at);
  }

  columns(m, from, out, at) { // the first two columns of a row-major rotation, as rows of two
    for (let k = 0; k < 2; k++) this.turn(m[from + k], m[from + 3 + k], m[from + 6 + k], out, at + k, 2);
  }
}

// env.observe_user [Eq. 4].  devices : { pos: [[3] …], rot: [[9] …] }
export function observeUser(frame, devices, out, at) {
  const d = devices.pos.length;
  devices.pos.forEach((p, i) => frame.place(...p, out, at + 3 * i));
  devices.rot.forEach((r, i) => frame.columns(r, 0, out, at + 3 * d + 6 * i));
  return at + 9 * d;
}

export function observeSim(frame, sim, out) { // env.observe_sim [Eq. 3]
  const { qpos, qvel, xpos, xmat, cvel, table } = sim;
  const j = qpos.length - 7;
  const links = table.obs_links;
  let at = 0;
  for (let i = 0; i < j; i++) out[at++] = qpos[7 + i];
  frame.turn(qvel[0], qvel[1], qvel[2], out, at);
  const w = 6 * table.root; // cvel: rotation first
  frame.turn(cvel[w], cvel[w + 1], cvel[w + 2], out, at + 3);
  at += 6;
  for (let i = 0; i < j; i++) out[at++] = qvel[6 + i];
  for (const b of links) {
    frame.place(xpos[3 * b], xpos[3 * b + 1], xpos[3 * b + 2], out, at);
    at += 3;
  }
  for (const b of links) {
    frame.columns(xmat, 9 * b, out, at);
    at += 6;
  }
  return at;
}

export function observe(sim, before, now, out) { // env.observe [Eq. 2]
  const frame = new HeadingFrame(sim.qpos);
  const at = observeSim(frame, sim, out);
  observeUser(frame, now, out, observeUser(frame, before, out, at));
  return out;
}
