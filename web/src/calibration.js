// Samples of any rate -> poses at 30 Hz in the character's world: twins of headset/calibration.py and of
// retarget.root_scale, sensor_scale, standing.

import { AXES, Clock, GAP, Guard, SAMPLE_RATE, UserError, blend, toFrame, toWorld } from './reader.js';
import { heading, quatAbout, quatMul, quatRotate } from './human.js';

export const CONTROL_RATE = 30;
export const CALIBRATION = 1.0; // s of headset
const SEEN = 1000; // readings kept of it
const AGAIN = 0.5; // s without a headset: it was put on meanwhile, and the second begins again.  ASSUMED
const STANDING = [1.0, 2.1]; // m, where the headset of a standing user may be; otherwise the floor is not at height 0
const AVERAGE = 1.64; // m, headset of a user of 1.75 m, taken where the floor is not known.  ASSUMED
const HIPS = 0.554; // of that height: the hips.  ASSUMED
export const HEADSET_AHEAD = [0.14, 0, 0]; // retarget.HEADSET_AHEAD [m]

export function rootScale(table, hipHeight) { // retarget.root_scale
  const { root_xy: xy, root_z: z } = table.scale;
  return [xy, xy, z === 'hip' ? table.hip_height / hipHeight : z];
}

export function sensorScale(table, hipHeight, headsetHeight) { // retarget.sensor_scale
  const scale = rootScale(table, hipHeight);
  const z = table.scale.sensors_z;
  if (z !== 'hip') scale[2] = z === 'headset' ? table.headset[2] / headsetHeight : z;
  return scale;
}

export function standing(table, pos, quat) { // retarget.standing: the default pose under a headset -> qpos
  const turn = quatAbout(2, heading(quat));
  const ahead = quatRotate(turn, HEADSET_AHEAD);
  const root = quatMul(turn, table.rest_root);
  return [pos[0] - ahead[0], pos[1] - ahead[1], table.hip_height, ...root, ...table.default];
}

export class Resampler { // calibration.Resampler
  constructor(rate = CONTROL_RATE) {
    [this.rate, this.k, this.t0, this.last] = [rate, 0, null, null];
  }

  push(sample) {
    if (this.t0 === null) [this.t0, this.last] = [sample.t, sample];
    const out = [];
    for (;;) {
      const tick = this.t0 + this.k / this.rate;
      if (!(tick <= sample.t + 1e-9)) break;
      const span = sample.t - this.last.t;
      const u = span > 0 ? Math.min(Math.max((tick - this.last.t) / span, 0), 1) : 1;
      const poses = [0, 1, 2].map((i) => blend(pose(this.last, i), pose(sample, i), u));
      out.push({ t: this.k / this.rate, pos: poses.map((p) => p[0]), quat: poses.map((p) => p[1]) });
      this.k += 1;
    }
    this.last = sample;
    return out;
  }
}

const pose = (sample, i) => [sample.pos[i], sample.quat[i]];

export function percentile(values, share) { // np.percentile, linear between ranks
  const sorted = [...values].sort((a, b) => a - b);
  const at = share * (sorted.length - 1);
  const low = Math.floor(at);
  const high = Math.min(low + 1, sorted.length - 1);
  return sorted[low] + (sorted[high] - sorted[low]) * (at - low);
}

const mean = (values) => values.reduce((a, b) => a + b, 0) / values.length;

export class Calibration { // calibration.Calibration: p' = s ⊙ R_z(−yaw) (p − origin)
  constructor(fields) {
    Object.assign(this, fields);
  }

  apply(sample) {
    const frame = [this.origin, quatAbout(2, this.yaw)];
    const poses = [0, 1, 2].map((i) => toFrame(frame, pose(sample, i)));
    return { t: sample.t, pos: poses.map(([p]) => p.map((x, k) => x * this.scale[k])), quat: poses.map((p) => p[1]) };
  }
}

export function calibrate(table, pos, quat, userHeight = null) { // calibration.calibrate
  const top = percentile(pos.map((p) => p[2]), 0.875);
  const estimated = userHeight !== null || !(STANDING[0] <= top && top <= STANDING[1]);
  const height = estimated ? userHeight || AVERAGE : top;
  const yaws = quat.map(heading);
  const yaw = Math.atan2(mean(yaws.map(Math.sin)), mean(yaws.map(Math.cos)));
  const origin = [percentile(pos.map((p) => p[0]), 0.5), percentile(pos.map((p) => p[1]), 0.5), top - height];
  const scale = sensorScale(table, HIPS * height, height);
  return new Calibration({ height, floor: top - height, estimated, yaw, origin, scale });
}

export class Stream { // calibration.Stream
  constructor(table, how = {}) {
    const { axes = 'unity', grip = null, unit = null, order = [0, 1, 2], sampleRate = SAMPLE_RATE, userHeight = null,
      devices = 3 } = how;
    if (!AXES[axes]) throw new UserError(`--axes ${axes}: unknown; valid: ${Object.keys(AXES).join(', ')}`);
    Object.assign(this, { table, axes, grip, unit, order, userHeight });
    this.clock = new Clock(sampleRate);
    this.guard = new Guard(CONTROL_RATE, devices);
    this.resampler = new Resampler();
    [this.calibration, this.seen, this.unseen, this.rows] = [null, [], 0, 0];
  }

  push(sample) {
    this.rows += 1;
    const t = this.clock.stamp(sample.t);
    if (t === null) return [];
    const [pos, quat] = [sample.pos, sample.quat].map((of) => this.order.map((i) => of[i]));
    return this.#go({ t, ...toWorld(pos, quat, this.axes, this.grip, this.unit) });
  }

  idle(seconds) { // nothing came for so long: the ticks of a drop-out
    if (this.guard.t === null) return [];
    const nothing = (n) => [0, 1, 2].map(() => Array(n).fill(NaN));
    return this.#go({ t: this.clock.idle(seconds), pos: nothing(3), quat: nothing(4) }, 'drop-out');
  }

  #go(sample, why = null) {
    const ticks = [];
    for (const s of this.guard.push(sample, why)) {
      if (this.calibration) {
        for (const tick of this.resampler.push(s)) ticks.push(this.calibration.apply(tick));
      } else if (this.guard.live()) {
        const gap = this.seen.length ? s.t - this.seen.at(-1).t : 0;
        this.unseen += Math.max(0, gap - GAP);
        if (gap > AGAIN) [this.seen, this.unseen] = [[], 0];
        this.seen.push(s);
        if (this.seen.length > SEEN) this.seen = this.seen.filter((_, i) => i % 2 === 0);
        if (this.tracked() >= CALIBRATION) {
          const [pos, quat] = [this.seen.map((x) => x.pos[0]), this.seen.map((x) => x.quat[0])];
          this.calibration = calibrate(this.table, pos, quat, this.userHeight);
          this.seen = [];
        }
      }
    }
    return ticks;
  }

  tracked() { // seconds of headset seen while calibrating; of the time between two readings GAP at most
    return this.seen.length ? this.seen.at(-1).t - this.seen[0].t - this.unseen : 0;
  }

  uncalibrated() { // calibration.Stream.uncalibrated: why there is no calibration
    const need = `calibration needs ${CALIBRATION.toFixed(1)} s`;
    if (!this.rows) return `no rows after the columns' names; ${need}`;
    const hint = { 'far away': ': centimetres? valid: metres', 'no rotation': ': valid: quaternions of length 1' };
    const bad = [...this.guard.heads].filter(([what]) => what).sort((a, b) => b[1] - a[1])
      .map(([what, n]) => `${n} ${what}${hint[what] || ''}`);
    if (this.clock.dropped) bad.push(`${this.clock.dropped} before their predecessor`);
    const why = bad.length ? `; of them ${bad.join(', ')}` : '';
    return `${this.rows} rows show the headset for ${this.tracked().toFixed(2)} s; ${need}${why}`;
  }
}
