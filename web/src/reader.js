// A headset's rows: columns, axes, and what can go wrong.  Twin of headset/reader.py, name by name.

import { cross, distance, heading, quatAbout, quatConj, quatMul, quatRotate, quatSlerp, subtract, add } from './human.js';

export class UserError extends Error {} // plumbing.cli.UserError: one line for the person at the page

export const DEVICES = ['head', 'left', 'right'];
export const PARTS = ['px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw'];
export const COLUMNS = ['time', ...DEVICES.flatMap((d) => PARTS.map((p) => `${d}_${p}`))];
export const SAMPLE_RATE = 90; // Hz, of a stream without times
const LINE_LIMIT = 65536;
const EMPTY = ['', 'nan', 'null', 'none'];
const [STEPS, JUDGED] = [[0.0005, 0.1], 11]; // s between two rows; steps by whose median a time column is judged
const SEPARATORS = { ';': 'semicolons', '\t': 'tabs', '|': 'bars', ' ': 'spaces' };

// ---------------------------------------------------------------------------------- reading

const HEAD = ['head', 'hmd', 'headset', 'centereyeanchor', 'centereye', 'maincamera'];
const SIDES = ['left', 'right'];
const HELD = ['hand', 'controller', 'touch', 'wand', 'index', 'anchor', 'device', 'tracker'];
const POSITION = ['p', 'pos', 'position', 'loc', 'location', 'translation'];
const ROTATION = ['q', 'quat', 'quaternion', 'rot', 'rotation', 'ori', 'orient', 'orientation'];
const MATRIX = ['m', 'mat', 'matrix', 'pose', 'transform'];
const AXIS = ['x', 'y', 'z', 'w'];
const LOOSE = ['l', 'r', 't', 'local', 'world', 'global', 'knuckles', 'oculus', 'quest', 'vive', 'camera'];
const [WORDS, LOOSE_WORDS] = [[], LOOSE].map((more) => [...HEAD, ...SIDES, ...HELD, ...POSITION, ...ROTATION, ...AXIS, ...more]
  .sort((a, b) => b.length - a.length));
const TIME = /^(?:delta|elapsed|session|system|unix|epoch|utc)?(?:time|timestamp|t)(s|sec|seconds|ms|us|ns|milliseconds)?$/;
const LENGTH = /[[(](?:(?:c|m)?m|(?:centi|milli)?met(?:re|er)s?)[\])]|[_ ](?:(?:c|m)?m|(?:centi|milli)?met(?:re|er)s?)$/gi;
const SECONDS = { ms: 1e-3, milliseconds: 1e-3, us: 1e-6, ns: 1e-9 };
const lettersOf = (text) => text.toLowerCase().replace(/[^a-z]/g, '');

export function column(name, loose = false) { // reader.column: the canonical name of a column, or null
  if (TIME.test(lettersOf(name))) return 'time';
  const text = name.trim().replace(/^"+|"+$/g, '').replace(LENGTH, '');
  const letters = lettersOf(text);
  const digits = text.match(/\d/g);
  if (digits) return matrixColumn(letters, digits);
  const words = wordsOf(letters, loose);
  const device = deviceOf(words);
  const axis = words.filter((w) => AXIS.includes(w));
  const [turns, moves] = [ROTATION, [...POSITION, 't']].map((kind) => words.some((w) => kind.includes(w)));
  if (!device || axis.length !== 1 || (turns && moves) || (axis[0] === 'w' && !turns)) return null;
  return `${device}_${turns ? 'q' : 'p'}${axis[0]}`;
}

function wordsOf(letters, loose) { // reader._words: the words that make up the letters, or none
  const words = loose ? LOOSE_WORDS : WORDS;
  const found = letters.length < 80 ? letters.match(new RegExp(words.join('|'), 'g')) ?? [] : [];
  return found.join('') === letters ? found : [];
}

function deviceOf(words) { // reader._device
  const devices = new Set(words.flatMap((w) => SIDES.filter((s) => w === s || w === s[0])));
  if (words.some((w) => HEAD.includes(w) || w === 'camera')) devices.add('head');
  return devices.size === 1 ? [...devices][0] : null;
}

export function columns(names, wanted) { // reader.columns: as they stand, loosely, or without what all begin with
  const ways = [names.map((n) => column(n)), names.map((n) => column(n, true)),
    withoutPrefix(names).map((n) => column(n, true))];
  const twice = (way) => way.some((c, i) => c && c !== 'time' && way.indexOf(c) !== i);
  const whole = (way) => {
    const there = told(way);
    return wanted.every((c) => there.has(c));
  };
  return ways.find((way) => whole(way) && !twice(way)) ?? ways[0];
}

function told(known) { // reader.told: the columns that are there, those of a matrix among them
  const whole = DEVICES.filter((d) => [0, 1, 2].every((i) => [0, 1, 2, 3].every((j) => known.includes(`${d}_m${i}${j}`))));
  return new Set([...known, ...whole.flatMap((d) => PARTS.map((p) => `${d}_${p}`))]);
}

function withoutPrefix(names) { // mocap.guess.without_prefix
  if (names.length < 5) return names;
  const middle = [...names].sort()[Math.floor(names.length / 2)].slice(0, 100);
  const shared = (k) => names.filter((n) => n.startsWith(middle.slice(0, k))).length >= 0.8 * names.length;
  let best = 0;
  while (best < middle.length && shared(best + 1)) best += 1;
  return names.map((n) => (n.startsWith(middle.slice(0, best)) && n.length > best ? n.slice(best) : n));
}

function matrixColumn(letters, digits) { // reader._matrix_column: "hmd_m03" -> head_m03
  const found = letters.match(new RegExp(`^(${[...HEAD, ...SIDES].join('|')})(?:${HELD.join('|')})*(?:${MATRIX.join('|')})*$`));
  if (!found || digits.length !== 2 || digits[0] > 2 || digits[1] > 3) return null;
  return `${deviceOf([found[1]])}_m${digits.join('')}`;
}

export const timeUnit = (name) => SECONDS[lettersOf(name).match(TIME)?.[1]] ?? 1; // reader.time_unit [s]

export function poseOf(m) { // reader.pose_of: 3 x 4 numbers of a matrix -> position, quaternion x, y, z, w
  const [a, b, c] = [0, 4, 8].map((i) => m.slice(i, i + 3));
  const dot = (u, v) => u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
  const near = (x, y) => Math.abs(x - y) <= 0.05 + 1e-5 * Math.abs(y); // as numpy.allclose
  const turned = [[a, a], [b, b], [c, c]].every(([u, v]) => near(dot(u, v), 1))
    && [[a, b], [a, c], [b, c]].every(([u, v]) => near(dot(u, v), 0)) && dot(a, cross(b, c)) >= 0;
  if (!m.every(Number.isFinite) || !turned) return Array(7).fill(NaN);
  const trace = a[0] + b[1] + c[2];
  const four = [ // each a multiple of the quaternion w, x, y, z: the longest is the exactest
    [1 + trace, c[1] - b[2], a[2] - c[0], b[0] - a[1]],
    [c[1] - b[2], 1 + 2 * a[0] - trace, a[1] + b[0], a[2] + c[0]],
    [a[2] - c[0], a[1] + b[0], 1 + 2 * b[1] - trace, b[2] + c[1]],
    [b[0] - a[1], a[2] + c[0], b[2] + c[1], 1 + 2 * c[2] - trace],
  ];
  const q = four.reduce((p, r) => (Math.hypot(...r) > Math.hypot(...p) ? r : p));
  const [w, x, y, z] = q.map((v) => v / Math.hypot(...q));
  return [m[3], m[7], m[11], x, y, z, w];
}

export function parseNumber(word) { // plumbing.files.parse_number: what Python's float() reads; NaN-or-throw
  const text = word.trim();
  if (/^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(text)) return Number(text);
  const special = text.match(/^([+-]?)(inf|infinity|nan)$/i);
  if (!special) throw new Error('no number');
  return special[2].toLowerCase() === 'nan' ? NaN : special[1] === '-' ? -Infinity : Infinity;
}

export const validColumns = () => // reader.valid_columns
  'time (optional) and DEVICE_px, _py, _pz, _qx, _qy, _qz, _qw for DEVICE head, left, right, '
  + "or a matrix's DEVICE_m00 to _m23";

export function* linesOf(text) { // reader.lines_of: lines with their ends
  for (let start = 0; start < text.length;) {
    const end = text.indexOf('\n', start);
    const stop = end < 0 ? text.length : end + 1;
    yield text.slice(start, stop);
    start = stop;
  }
}

export class Reader { // reader.Reader, of files: a line that cannot be read is an error, a last one cut short is not
  constructor(name, devices = 3) {
    Object.assign(this, { name, steps: [], before: null, line: 0, unreadable: 0, at: null, names: null });
    this.wanted = COLUMNS.slice(0, 1 + devices * PARTS.length);
    [this.matrices, this.second] = [[], 1];
    this.axes = null; // ours: what a comment before the columns says, as the page's own recordings do
  }

  fail(text) {
    throw new UserError(`${this.name}${text}`);
  }

  * read(lines) {
    for (const text of lines) {
      this.line += 1;
      if (this.at === null && text.trim().includes('\r') && !text.includes('\0')) {
        this.fail(`, line ${this.line}: line ends of CR alone; valid: LF, or CR and LF`);
      }
      if (text.length >= LINE_LIMIT) {
        this.fail(`, line ${this.line}: longer than ${LINE_LIMIT} bytes; valid: a CSV's lines`);
      }
      const cells = text.replace(/^\ufeff+/, '').trim();
      if (!cells || cells.startsWith('#')) {
        this.axes ??= cells.match(/^#.*\baxes:? (\w+)/)?.[1] ?? null;
        continue;
      }
      if (this.at === null) {
        if (text.includes('\0')) this.fail(`, line ${this.line}: UTF-16 or no text; valid: a CSV's lines in UTF-8`);
        this.header(cells);
        continue;
      }
      let values;
      try {
        values = this.values(cells);
      } catch (error) {
        if (!(error instanceof UserError)) throw error;
        this.unreadable += 1;
        if (text.endsWith('\n')) this.fail(`, line ${this.line}, ${error.message}`);
        continue;
      }
      const device = (d) => values.slice(1 + 7 * d, 8 + 7 * d);
      if (this.steps.length < JUDGED && !fault(device(0), Infinity)) this.judge(values[0]);
      const rows = [0, 1, 2].map(device);
      yield { t: values[0], pos: rows.map((r) => r.slice(0, 3)), quat: rows.map((r) => r.slice(3)) };
    }
    if (this.at === null) this.fail(`: is empty; expected a line of column names: ${validColumns()}`);
  }

  judge(t) { // reader.Reader.judge: can the first times be a headset's seconds?
    if (Number.isFinite(t)) {
      if (this.before !== null) this.steps.push(t - this.before);
      this.before = t;
    }
    if (this.steps.length < JUDGED) return;
    const sum = this.steps.reduce((a, b) => a + b, 0);
    const step = [...this.steps].sort((a, b) => a - b)[JUDGED >> 1] || sum / JUDGED;
    if (STEPS[0] <= step && step < 0.999 * STEPS[1]) return;
    const named = { milliseconds: 1e-3, microseconds: 1e-6, nanoseconds: 1e-9, minutes: 60, hours: 3600 };
    const rate = (u) => 1 / Math.max(Math.abs(step) * u, 1e-300);
    const unit = Object.keys(named).find((k) => rate(named[k]) >= 20 && rate(named[k]) <= 1000);
    const short = (x) => String(Number(x.toPrecision(3)));
    let valid = `seconds that increase, ${1 / STEPS[1]} to ${1 / STEPS[0]} rows in each`;
    let what = `time steps of ${short(step)} s${unit ? `: ${unit}?` : ''}`;
    if (step <= 0) {
      what = step ? `time runs backwards, by ${short(-step)} s a row` : 'time stands still';
      valid += ', or no column time (then the sample rate says how many)';
    }
    this.fail(`, line ${this.line}, column ${this.names[this.at[0]]}: ${what}; valid: ${valid}`);
  }

  header(line) { // reader.Reader.header: where which column is
    this.names = line.split(',').map((c) => c.trim());
    const known = columns(this.names, this.wanted.slice(1));
    const ours = (mark) => line.split(mark).filter((c) => column(c)).length;
    const mark = Object.keys(SEPARATORS).reduce((a, b) => (ours(b) > ours(a) ? b : a));
    if (ours(mark) > Math.max(known.filter((c) => c).length, 1)) {
      const valid = 'commas, and points in the numbers';
      this.fail(`, line ${this.line}: ${SEPARATORS[mark]} between the columns; valid: ${valid}`);
    }
    const used = DEVICES.slice(0, Math.floor(this.wanted.length / PARTS.length));
    const entries = used.map((d) => [0, 1, 2].flatMap((i) => [0, 1, 2, 3].map((j) => `${d}_m${i}${j}`)));
    this.matrices = entries.map((names, k) => [k, names.map((c) => known.indexOf(c))])
      .filter(([, at]) => at.every((i) => i >= 0));
    const there = told(known);
    const missing = this.wanted.slice(1).filter((c) => !there.has(c));
    const twice = known.find((c, i) => c && c !== 'time' && known.indexOf(c) !== i);
    if (twice) this.fail(`, line ${this.line}: column ${twice} is there twice; valid: once each`);
    if (missing.length) {
      const more = missing.length > 4 ? ` and ${missing.length - 4} more` : '';
      const alone = missing.some((c) => c.startsWith('head')) ? '' : '; "headset alone" needs the headset\'s only';
      const has = this.names.join(', ').slice(0, 200);
      this.fail(`, line ${this.line}: no column ${missing.slice(0, 4).join(', ')}${more}; it has ${has}; `
        + `valid: ${validColumns()}${alone}`);
    }
    this.at = this.wanted.map((c) => known.indexOf(c));
    this.second = this.at[0] >= 0 ? timeUnit(this.names[this.at[0]]) : 1;
  }

  values(line) { // reader.Reader.values: the numbers of a row in the order of COLUMNS
    const cells = line.split(',');
    if (cells.length !== this.names.length) {
      const name = this.names[Math.min(cells.length, this.names.length) - 1];
      const comma = cells.length > this.names.length ? ' (commas in the numbers? valid: points)' : '';
      const valid = `${this.names.length}, as in the first line${comma}`;
      throw new UserError(`column ${name}: ${cells.length} cells; valid: ${valid}`);
    }
    const out = Array(COLUMNS.length).fill(NaN);
    this.at.forEach((i, k) => { out[k] = this.number(cells, i); });
    out[0] *= this.second;
    this.matrices.forEach(([k, at]) => {
      poseOf(at.map((i) => this.number(cells, i))).forEach((x, j) => { out[1 + 7 * k + j] = x; });
    });
    return out;
  }

  number(cells, i) { // reader.Reader.number: NaN for a column that is not there, or an empty cell
    const cell = i >= 0 ? cells[i].trim().replace(/^"+|"+$/g, '') : '';
    if (EMPTY.includes(cell.toLowerCase())) return NaN;
    try {
      return parseNumber(cell);
    } catch {
      throw new UserError(`column ${this.names[i]}: '${cell.slice(0, 40)}'; valid: a number, or nothing`);
    }
  }
}

// ---------------------------------------------------------------------------------- axes

export const AXES = { // reader.AXES: rows are our x, y, z in the source's coordinates
  unity: [[0, 0, 1], [-1, 0, 0], [0, 1, 0]],
  openxr: [[0, 0, -1], [-1, 0, 0], [0, 1, 0]], // WebXR's, too
  mujoco: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
  openvr: [[0, 0, -1], [-1, 0, 0], [0, 1, 0]],
  unreal: [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
};
const MIRRORED = { unity: -1, openxr: 1, mujoco: 1, openvr: 1, unreal: -1 }; // the matrices' determinants
export const UNIT = { unreal: 0.01 }; // reader.UNIT: metres a unit, where it is not 1
export const GRIP = { unity: 15, openxr: 90, mujoco: 90, openvr: 15, unreal: 15 }; // reader.GRIP [degrees]

export function toWorld(pos, quat, axes, grip = null, unit = null) { // reader.to_world
  const m = AXES[axes];
  const apply = (v) => m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
  const degrees = -90 + (grip ?? GRIP[axes]);
  const turn = quatAbout(1, (degrees * Math.PI) / 180);
  return {
    pos: pos.map((v) => apply(v).map((x) => x * (unit ?? UNIT[axes] ?? 1))),
    quat: quat.map((q, i) => {
      const own = [q[3], ...apply(q).map((x) => MIRRORED[axes] * x)];
      return i && degrees ? quatMul(own, turn) : own;
    }),
  };
}

// ---------------------------------------------------------------------------------- what can go wrong

export const GAP = 0.1; // s without a row: a drop-out
const FROZEN = 0.25; // s without any change while another device moves: lost
const FAR_AWAY = 100; // m from the source's origin: not a place
const REACH = 1.5; // m from headset to controller: longer than an arm
const TELEPORT = 1.0; // m between two headset poses: the stream is re-anchored
const STEP = 0.2; // m between two samples of a headset: too fast for a head
const JUMP = 0.5; // m between two samples of a controller: too fast for a hand
const SETTLE = 0.1; // s that a controller which jumped must stay where it is
const [HOLD, RELAX] = [1.0, 0.5]; // s that a lost controller is held; time constant with which it then sinks
const [COAST, SMOOTH] = [0.5, 0.15]; // s: time constants with which a lost headset slows down, its velocity is taken
const [BLEND, CATCH_UP] = [0.3, 2.0]; // s, m/s: the way back from the held to the true pose
const [CLOCK_AHEAD, CLOCK_BACK] = [5, 1]; // s: farther jumps of the time column are another clock
const NEUTRAL = [[0, 0, 0], [-0.04, 0.26, -0.9], [-0.04, -0.26, -0.9]]; // m, the hanging hand.  ASSUMED
const IDENTITY = [1, 0, 0, 0];

export class Clock { // reader.Clock: the time column -> seconds since the first row, never backwards
  constructor(rate = SAMPLE_RATE) {
    Object.assign(this, { rate, last: null, base: 0, dropped: 0, jumps: 0, same: 0, forget: false });
  }

  stamp(t) { // seconds since the first row, or null for a row to drop
    const finite = Number.isFinite(t);
    if (this.last === null) {
      this.base = finite ? -t : 0;
      this.last = 0;
      return 0;
    }
    let step = finite ? t + this.base - this.last : 1 / this.rate;
    if (Math.abs(step) < 1e-9) step = 0;
    this.same = step === 0 ? this.same + 1 : 0;
    if (this.forget || this.same >= 10 || !(-CLOCK_BACK <= step && step <= CLOCK_AHEAD)) {
      if (!this.forget) this.jumps += 1;
      step = 1 / this.rate;
      if (finite) this.base = this.last + step - t;
    }
    this.forget = false;
    if (step < 0) {
      this.dropped += 1;
      return null;
    }
    this.last += step;
    return this.last;
  }

  idle(seconds) { // time goes on without rows
    [this.last, this.forget] = [(this.last || 0) + seconds, true];
    return this.last;
  }
}

export function fault(row, far = FAR_AWAY) { // reader.fault: why a device's row cannot be a pose, or null
  if (!row.every(Number.isFinite)) return 'not finite';
  if (row.every((x) => x === 0)) return 'all zero';
  if (Math.max(...row.slice(0, 3).map(Math.abs)) > far) return 'far away';
  const norm = Math.hypot(...row.slice(3).map((x) => Math.min(Math.max(x, -1e3), 1e3)));
  return Math.abs(norm - 1) > 0.1 ? 'no rotation' : null;
}

const newTrack = () => ({ // reader.Track
  raw: null, changed: -Infinity, good: null, yaw: 0, lost: 'not seen', since: 0, jumped: null, settling: 0, last: null,
  held: null, mix: 1, pace: 0, velocity: [0, 0, 0],
});

export class Guard { // reader.Guard: three devices that may be lost at any time -> three finite poses
  constructor(rate, devices = 3) {
    Object.assign(this, { rate, devices, t: null, yaw: 0, shift: [0, 0, 0] });
    this.tracks = DEVICES.map(newTrack);
    [this.events, this.heads] = [new Map(), new Map()]; // "device what" -> times; what the headset's rows were
  }

  push(sample, why = null) { // the poses to use, in order; several after a drop-out, none before the headset is seen
    const out = [];
    if (this.t !== null && sample.t - this.t > GAP) {
      const nothing = [0, 1, 2].map(() => Array(7).fill(NaN));
      while (this.t + 1 / this.rate < sample.t) out.push(this.one(this.t + 1 / this.rate, nothing, 'drop-out'));
    }
    out.push(this.one(sample.t, sample.pos.map((p, i) => [...p, ...sample.quat[i]]), why));
    return out.filter((s) => s);
  }

  live(device = 0) { // is the last pose the device's own, not a held or blended one?
    return this.tracks[device].lost === null && this.tracks[device].mix >= 1;
  }

  report() { // reader.Guard.report, without the seconds
    return [...this.events].filter(([key]) => DEVICES.indexOf(key.split(' ')[0]) < this.devices).sort()
      .map(([key, n]) => `${key}: ${n} time${n > 1 ? 's' : ''}`);
  }

  one(t, rows, why) {
    const dt = this.t === null ? 0 : t - this.t;
    this.t = t;
    const faults = rows.map((row) => why || fault(row));
    this.tracks.forEach((track, i) => {
      if (!faults[i] && (track.raw === null || track.raw.some((x, k) => x !== rows[i][k]))) {
        [track.raw, track.changed] = [rows[i], t];
      }
    });
    const newest = Math.max(...this.tracks.map((track) => track.changed));
    this.tracks.forEach((track, i) => {
      if (!faults[i] && t - track.changed > FROZEN && newest > track.changed) faults[i] = 'frozen';
    });
    if (why === null) this.heads.set(faults[0], (this.heads.get(faults[0]) || 0) + 1);
    rows = rows.map((row, i) => (faults[i] ? [0, 0, 0, 1, 0, 0, 0] : row));
    const unit = rows.map((row) => {
      const norm = Math.hypot(...row.slice(3));
      return row.slice(3).map((x) => x / norm);
    });
    if (!faults[0]) this.anchor(rows[0].slice(0, 3), unit[0]);
    const turn = quatAbout(2, this.yaw);
    const pos = rows.map((row) => add(quatRotate(turn, row.slice(0, 3)), this.shift));
    const quat = unit.map((q) => quatMul(turn, q));
    const head = this.device(0, t, dt, faults[0], [pos[0], quat[0]], [[0, 0, 0], IDENTITY]);
    if (head === null) return null;
    const frame = [head[0], quatAbout(2, heading(head[1]))];
    const out = [head];
    for (const i of [1, 2]) {
      const bad = faults[i] || this.astray(i, t, pos[i], head[0]);
      out.push(this.device(i, t, dt, bad, [pos[i], quat[i]], frame));
    }
    return { t, pos: out.map((p) => p[0]), quat: out.map((p) => p[1]) };
  }

  anchor(pos, quat) { // re-anchor the stream if its headset, given as it came, is suddenly elsewhere
    const head = this.tracks[0];
    const place = () => add(quatRotate(quatAbout(2, this.yaw), pos), this.shift);
    if (head.good !== null && distance(place(), head.good) > TELEPORT) {
      this.count('head', 'teleport');
      this.yaw = head.yaw - heading(quat);
      const gap = subtract(head.good, place());
      this.shift = add(this.shift, [gap[0], gap[1], Math.abs(gap[2]) > 0.5 ? gap[2] : 0]);
    }
    head.yaw = heading(quat) + this.yaw;
  }

  astray(i, t, pos, head) { // why a controller's usable row is not to be believed, or null
    const track = this.tracks[i];
    if (distance(pos, head) > REACH) return 'out of reach';
    if ([null, 'jump'].includes(track.lost) && track.good !== null && distance(pos, track.good) > JUMP) {
      if (track.jumped === null || distance(pos, track.jumped) > JUMP) track.settling = t;
      track.jumped = pos;
      if (t - track.settling < SETTLE) return 'jump';
    }
    track.jumped = null;
    return null;
  }

  device(i, t, dt, bad, truth, frame) { // hold, blend or believe one device; null: a headset never seen
    const track = this.tracks[i];
    if (bad) {
      if (track.last === null && i === 0) return null;
      track.last ??= [NEUTRAL[i], IDENTITY];
      if (track.lost === null || track.held === null) [track.held, track.since] = [track.last, t];
      if (track.lost !== bad) this.count(DEVICES[i], bad);
      [track.lost, track.mix] = [bad, 0];
      if (i === 0) { // the way of v e^(-s / COAST) since the row before
        const way = COAST * Math.exp(-(t - track.since) / COAST) * Math.expm1(dt / COAST);
        const on = (x, k) => x + way * track.velocity[k];
        [track.held, track.good] = [[track.held[0].map(on), track.held[1]], track.good.map(on)];
      } else if (t - track.since > HOLD) {
        track.held = blend(track.held, [NEUTRAL[i], IDENTITY], 1 - Math.exp(-dt / RELAX));
      }
      track.last = track.held;
    } else {
      const own = toFrame(frame, truth);
      const step = i === 0 && track.lost === null && distance(truth[0], track.good) > STEP;
      if (track.last !== null && (track.lost || step)) {
        if (step) this.count('head', 'step');
        [track.held, track.mix] = [track.last, 0];
        const fade = step ? BLEND : Math.min(BLEND, Math.max(t - track.since, 1e-6));
        track.pace = 1 / Math.max(fade, distance(own[0], track.held[0]) / CATCH_UP);
      }
      if (i === 0 && track.lost === null && track.good !== null && dt > 0 && !step) {
        const fresh = truth[0].map((x, k) => (k < 2 ? (x - track.good[k]) / dt : 0));
        track.velocity = track.velocity.map((v, k) => v + (1 - Math.exp(-dt / SMOOTH)) * (fresh[k] - v));
      }
      [track.lost, track.good] = [null, truth[0]];
      track.mix = Math.min(1, track.mix + dt * track.pace);
      track.last = track.mix >= 1 ? own : blend(track.held, own, track.mix);
    }
    return fromFrame(frame, track.last);
  }

  count(device, what) {
    this.events.set(`${device} ${what}`, (this.events.get(`${device} ${what}`) || 0) + 1);
  }
}

export function blend(a, b, share) { // reader.blend: between two poses [pos, quat]
  return [a[0].map((x, k) => x + share * (b[0][k] - x)), quatSlerp(a[1], b[1], share)];
}

export function toFrame(frame, pose) { // reader.to_frame
  const back = quatConj(frame[1]);
  return [quatRotate(back, subtract(pose[0], frame[0])), quatMul(back, pose[1])];
}

export function fromFrame(frame, pose) { // reader.from_frame
  return [add(frame[0], quatRotate(frame[1], pose[0])), quatMul(frame[1], pose[1])];
}
