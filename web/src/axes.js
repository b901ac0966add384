// Which axes, unit, grip and order of devices fit a person: for a file whose axes nobody told.  Twin of headset/axes.py,
// whose first lines say what tells; name by name.

import { heading, quatMatrix, quatRotate, subtract } from './human.js';
import { AXES, DEVICES, GRIP, UNIT, toWorld } from './reader.js';

const SECONDS = 11; // of headset that are looked at
const LONG = 60; // s of a file in whose first eleven both controllers lie still
const SEEN = 30; // Hz, at most as many readings
const NAMES = ['unity', 'openxr', 'mujoco', 'unreal']; // openvr has the axes of openxr
const UNITS = [1, 0.01, 0.001]; // metres a unit
const REACH = [0.25, 1.4]; // m from headset to controller, in the median
const [LAG, FARTHEST, LIES, HANGS, WALKS] = [0.1, 1e6, 0.01, 0.1, 0.4];
const [SWAPPED, PERSON, SURE, OTHER_GRIP, GRIP_OFF] = [0.8, 4, 0.6, 0.3, 45];
const NOBODY =
  'fits no person well: are the columns in place, rotations x, y, z, w?  (A controller that lies fits badly)';
const ORDERS = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
const DEGREES = 180 / Math.PI;

const cut = (x) => Math.min(Math.max(x, -1), 1);
const mean = (values) => values.reduce((a, b) => a + b, 0) / values.length;
const same = (a, b) => a.every((x, k) => x === b[k]);
const gripOf = (forearm) => [...new Set(Object.values(GRIP))].reduce( // axes.grip_of
  (a, b) => (Math.abs(b - forearm) < Math.abs(a - forearm) ? b : a));

function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
}

function deviation(points) { // the largest standard deviation along an axis
  return Math.max(...[0, 1, 2].map((k) => {
    const middle = mean(points.map((p) => p[k]));
    return Math.sqrt(mean(points.map((p) => (p[k] - middle) ** 2)));
  }));
}

export function tracked(samples, devices = 3) { // axes.tracked: every device has a pose, at most 30 a second
  const out = [];
  for (const s of samples) {
    const whole = s.pos.slice(0, devices).every((p, i) => [...p, ...s.quat[i]].every((x) => Math.abs(x) < FARTHEST)
      && Math.abs(Math.hypot(...s.quat[i]) - 1) < 0.1);
    if (whole && (!out.length || !(s.t - out.at(-1).t < 0.9 / SEEN))) out.push(s);
  }
  return out;
}

// axes.lever: r of p = c + R r with c at rest for 0.1 s, by least squares with a ridge; and the share that it explains.
export function lever(t, pos, quat, lag = LAG) {
  const steps = t.slice(1).map((x, i) => x - t[i]);
  const k = Math.max(1, Math.round(lag / Math.max(median(steps), 1e-3)));
  const turns = quat.map(quatMatrix);
  const m = Array(9).fill(0);
  const ab = [0, 0, 0];
  const rows = [];
  for (let i = 0; i + k < pos.length; i++) {
    for (let j = 0; j < 3; j++) {
      const a = [0, 1, 2].map((c) => turns[i + k][3 * j + c] - turns[i][3 * j + c]);
      const b = pos[i + k][j] - pos[i][j];
      rows.push([a, b]);
      for (let c = 0; c < 3; c++) {
        ab[c] += a[c] * b;
        for (let d = 0; d < 3; d++) m[3 * c + d] += a[c] * a[d];
      }
    }
  }
  if (!rows.some(([, b]) => Math.abs(b) > 0)) return [[0, 0, 0], 0];
  const ridge = 1e-3 * (m[0] + m[4] + m[8]) + 1e-9;
  for (const c of [0, 4, 8]) m[c] += ridge;
  const r = solve(m, ab);
  let [left, all] = [0, 0];
  for (const [a, b] of rows) {
    left += (b - (a[0] * r[0] + a[1] * r[1] + a[2] * r[2])) ** 2;
    all += b * b;
  }
  return [r, Math.max(0, 1 - left / all)];
}

function solve(m, b) { // a symmetric 3 x 3 system, by Cramer's rule
  const det = (a) => a[0] * (a[4] * a[8] - a[5] * a[7]) - a[1] * (a[3] * a[8] - a[5] * a[6]) + a[2] * (a[3] * a[7] - a[4] * a[6]);
  const whole = det(m);
  return [0, 1, 2].map((k) => det(m.map((x, i) => (i % 3 === k ? b[Math.floor(i / 3)] : x))) / whole);
}

function levers(t, samples) { // axes.levers: of each device seen from each other, in the file's axes
  const own = samples.map((s) => s.quat.map(([x, y, z, w]) => [w, x, y, z]));
  const seen = (h, k) => lever(t, samples.map((s) => subtract(s.pos[k], s.pos[h])), own.map((q) => q[k]));
  return [0, 1, 2].map((h) => [0, 1, 2].map((k) => (h === k ? null : seen(h, k))));
}

// axes.fit: how well axes, an order of the devices and a unit fit a person; the sum of the cues, each from -1 to 1.
function fit(t, samples, swings, axes, order, unit) {
  const poses = samples.map((s) => toWorld(order.map((i) => s.pos[i]), order.map((i) => s.quat[i]), axes, 90, unit || 1));
  const [p, head] = [poses.map((s) => s.pos), poses.map((s) => s.quat[0])];
  const yaw = head.map(heading);
  const along = (v, i) => v[0] * Math.cos(yaw[i]) + v[1] * Math.sin(yaw[i]);
  const aside = (v, i) => v[1] * Math.cos(yaw[i]) - v[0] * Math.sin(yaw[i]);
  const hand = [0, 1].map((k) => p.map((row) => subtract(row[1 + k], row[0])));
  const held = [0, 1].filter((k) => deviation(p.map((row) => row[1 + k])) > LIES);
  const left = hand.map((rows) => mean(rows.map(aside)));
  const up = mean(head.map((q) => quatRotate(q, [0, 0, 1])[2]));
  const height = median(p.map((row) => row[0][2]));
  let score = cut(2 * up - 1) + (height > 0.5 && height < 2.3 ? 1 : Math.abs(height) < 0.5 ? 0 : -1);
  if (held.length) {
    const forward = mean(held.map((k) => mean(hand[k].map(along))));
    score += cut(-mean(held.map((k) => mean(hand[k].map((v) => v[2])))) / 0.3);
    score += cut((Math.sign(forward) * Math.max(0, Math.abs(forward) - HANGS)) / 0.2);
  }
  if (held.length === 2) score += cut((left[0] - left[1]) / 0.3) - cut(Math.abs(mean(left)) / 0.3);
  let carried = 0;
  for (let i = 0; i + 1 < p.length; i++) {
    const step = subtract(p[i + 1][0], p[i][0]);
    if (Math.hypot(step[0], step[1]) > WALKS * (t[i + 1] - t[i])) carried += along(step, i);
  }
  score += cut(carried);
  const found = [];
  for (const k of held) {
    const [own, share] = swings[order[0]][order[1 + k]];
    const r = AXES[axes].map((row) => (row[0] * own[0] + row[1] * own[1] + row[2] * own[2]) * (unit || 1));
    const long = Math.hypot(...r);
    if (share < 0.2 || !(long > 0.05 && long < 1)) continue;
    const angle = Math.atan2(-r[2], r[0]) * DEGREES;
    const off = Math.max(0, -10 - angle, angle - 90);
    score += ((2 * share) / held.length) * cut(1 - off / 30 - (Math.abs(r[1]) / long) ** 2);
    found.push([angle, share]);
  }
  const weight = found.reduce((sum, [, share]) => sum + share, 0);
  const forearm = found.length ? found.reduce((sum, [angle, share]) => sum + angle * share, 0) / weight : null;
  if (forearm !== null && Math.abs(forearm - GRIP[axes]) > GRIP_OFF) score -= OTHER_GRIP;
  return { axes, order, unit, score, forearm };
}

export function fits(readings, devices = 3) { // axes.fits: best first; none of too few, or of a headset alone
  const samples = tracked(readings, devices);
  if (devices < 3 || samples.length < 20) return [];
  let t = samples.map((s) => s.t);
  if (!t.every(Number.isFinite) || t.at(-1) - t[0] < 0.5) t = t.map((_, i) => i / 90);
  const unit = unitOf(samples);
  const swings = levers(t, samples);
  const orders = unit ? ORDERS : ORDERS.slice(0, 1);
  const found = [];
  for (const some of [orders.slice(0, 2), orders.slice(2)]) { // the headset first; elsewhere only if nobody wears it there
    if (found.length && Math.max(...found.map((f) => f.score)) >= PERSON) continue;
    for (const axes of NAMES) found.push(...some.map((order) => fit(t, samples, swings, axes, order, unit)));
  }
  const key = (f) => (same(f.order, ORDERS[0]) ? 0 : SWAPPED) - f.score;
  return found.sort((a, b) => key(a) - key(b));
}

function unitOf(samples) { // axes.unit_of: metres a unit, or null
  const apart = median(samples.flatMap((s) => [1, 2].map((k) => Math.hypot(...subtract(s.pos[k], s.pos[0])))));
  return UNITS.find((unit) => REACH[0] <= apart * unit && apart * unit <= REACH[1]) ?? null;
}

export function guess(samples, axes = 'unity', devices = 3) { // axes.guess
  const found = fits(samples, devices);
  if (!found.length) {
    return { axes, grip: null, unit: null, order: ORDERS[0], lines: [`too little to tell the axes from: --axes ${axes}`] };
  }
  const best = found[0];
  const rest = found.filter((f) => f.axes !== best.axes && same(f.order, best.order));
  const lead = best.score - Math.max(...rest.map((f) => f.score));
  let grip = GRIP[best.axes];
  if (best.forearm !== null && Math.abs(best.forearm - grip) > GRIP_OFF) grip = gripOf(best.forearm);
  const order = same(best.order, ORDERS[0]) ? '' : ` --devices ${best.order.map((k) => DEVICES[k]).join(',')}`;
  const unit = [null, UNIT[best.axes] ?? 1].includes(best.unit) ? null : best.unit;
  const flags = `--axes ${best.axes} --grip ${grip}${order}${unit ? ` --stream-unit ${unit}` : ''}`;
  const sure = lead > SURE ? '' : `; not sure: ${rest[0].axes} fits nearly as well`;
  const odd = best.score < PERSON ? `; ${best.score.toFixed(1)} of 8: ${NOBODY}` : '';
  const lines = [`axes found from head, hands and forearms: ${flags}${sure}${odd}`];
  return { axes: best.axes, grip, unit, order: best.order, lines };
}

function beginning(samples, seconds) { // axes.beginning
  const out = [];
  let [first, k] = [null, 0];
  for (const sample of samples) {
    if (sample.pos[0].every(Number.isFinite) && sample.quat[0].some((x) => x !== 0)) {
      first ??= sample.t;
      out.push(sample);
    }
    const timed = first !== null && Number.isFinite(sample.t);
    if ((timed && sample.t - first > seconds) || k > 40_000 || (!timed && out.length > 90 * seconds)) break;
    k += 1;
  }
  return out;
}

function lie(readings) { // axes.lie: both controllers are in nobody's hands
  const samples = tracked(readings);
  const scale = samples.length ? unitOf(samples) || 1 : 1;
  return samples.length > 0 && [1, 2].every((k) => deviation(samples.map((s) => s.pos[k])) * scale < LIES);
}

export function choose(read, devices = 3) { // axes.choose for "auto"; read() gives a file's samples anew
  let samples = beginning(read(), SECONDS);
  if (devices === 3 && lie(samples)) samples = beginning(read(), LONG); // until somebody takes them
  return guess(samples, 'unity', devices);
}
