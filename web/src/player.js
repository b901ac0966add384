// One character, driven by sensor poses.  Twin of headset.player.Player for one character.

import { CONTROL_RATE, HEADSET_AHEAD, standing } from './calibration.js';
import { distance, heading, quatAbout, quatMatrix, quatRotate, subtract, cross } from './human.js';
import { observe } from './env.js';

const AWAY = 1.0; // m, horizontally from the headset to the root: the character has lost the user

export class Player {
  constructor(sim) {
    this.sim = sim;
    this.devices = sim.table.policy.devices;
    this.obs = new Float32Array(sim.table.policy.sizes[0]);
    this.before = null;
    this.pull = null; // { body, at, target }: the page's drag
    this.restart();
  }

  restart() { // counts anew
    this.ticks = 0;
    this.ends = { fall: 0, away: 0, bad: 0 };
    [this.headError, this.handError] = [0, 0];
  }

  stand(pos, quat) { // Player.stand: the default pose under the headset, as fast as it horizontally
    const { sim, before } = this;
    sim.qpos.set(standing(sim.table, pos[0], quat[0]));
    for (const array of [sim.qvel, sim.ctrl, sim.qacc_warmstart, sim.xfrc_applied]) array.fill(0);
    if (before) for (const k of [0, 1]) sim.qvel[k] = (pos[0][k] - before.pos[0][k]) * CONTROL_RATE;
    sim.refresh();
  }

  step({ pos, quat }) { // Player.step: one control step -> why it had to stand anew, or null
    const { sim } = this;
    const seen = pos.slice(0, this.devices);
    const rot = quat.slice(0, this.devices).map((q) => quatMatrix(q).map(Math.fround));
    const now = { pos: seen, rot };
    if (this.before === null) {
      this.stand(pos, quat);
      this.before = now;
    }
    const errors = sim.table.sensor_sites.map((s, i) => distance(sim.site_xpos.subarray(3 * s, 3 * s + 3), pos[i]));
    this.headError += errors[0];
    this.handError += (errors[1] + errors[2]) / 2;
    observe(sim, this.before, now, this.obs);
    this.action = sim.policy.meanAction(this.obs);
    for (let i = 0; i < sim.ctrl.length; i++) sim.ctrl[i] = Math.min(Math.max(this.action[i], -1), 1);
    this.#apply(this.pull);
    const kept = sim.step();
    this.ticks += 1;
    const end = kept ? this.#end(pos) : 'bad';
    if (end) {
      this.ends[end] += 1;
      this.stand(pos, quat);
    }
    this.before = now;
    return end;
  }

  #end(pos) { // Player._ends
    const { qpos, qvel, ctrl } = this.sim;
    if (![qpos, qvel, ctrl].every((a) => a.every(Number.isFinite))) return 'bad';
    if (this.sim.lowest() <= 0) return 'fall';
    const ahead = quatRotate(quatAbout(2, heading(qpos.subarray(3, 7))), HEADSET_AHEAD);
    const away = Math.hypot(qpos[0] + ahead[0] - pos[0][0], qpos[1] + ahead[1] - pos[0][1]);
    return away > AWAY ? 'away' : null;
  }

  // A spring between a point of a body and where the visitor drags it; at most three metres a second squared.
  #apply(pull) {
    const { sim } = this;
    sim.xfrc_applied.fill(0);
    if (!pull) return;
    const { body: b, at, target } = pull;
    const q = sim.xquat.subarray(4 * b, 4 * b + 4);
    const arm = quatRotate(q, at);
    const point = [0, 1, 2].map((k) => sim.xpos[3 * b + k] + arm[k]);
    const gap = subtract(target, point);
    const size = Math.hypot(...gap);
    if (!(size > 0)) return;
    const force = gap.map((x) => (x / size) * sim.mass * Math.min(5 * size, 3));
    const centre = sim.xipos.subarray(3 * b, 3 * b + 3);
    sim.xfrc_applied.set([...force, ...cross(subtract(point, centre), force)], 6 * b);
  }

  get failures() {
    return this.ends.fall + this.ends.away + this.ends.bad;
  }
}
