// Beat Saber's replays, *.bsor of BeatLeader.  Twin of headset/bsor.py, name by name; the format is described there.

import { DEVICES, PARTS, UserError } from './reader.js';

const [MAGIC, VERSION] = [[0x69, 0x3d, 0x2d, 0x44], 1];
const SECTIONS = ['info', 'frames', 'notes', 'walls', 'heights', 'pauses'];
const STRINGS = ['version', 'game version', 'timestamp', "player's id", "player's name", 'platform', 'tracking system', 'hmd',
  'controller', 'hash', "song's name", 'mapper', 'difficulty'];
const INFO = [ // name, and the kind; s: a string
  ...STRINGS.map((name) => [name, 's']), ['score', 'i'], ['mode', 's'], ['environment', 's'], ['modifiers', 's'],
  ['jump distance', 'f'], ['left-handed', 'B'], ['height', 'f'], ['start time', 'f'], ['fail time', 'f'], ['speed', 'f'],
];
const FRAME = 8 + 4 * DEVICES.length * PARTS.length; // bytes: time, frames a second, poses
const [NOTE, CUT] = [16, 72]; // bytes of a note's event, and of the cut that follows one of kind 0 or 1
const SIZES = { walls: 16, heights: 8, pauses: 12 };
const [STRING, NAME, TRIED, PAUSE] = [2 ** 16, 255, 1000, 1e6];
const PACES = { SS: 0.85, FS: 1.2, SF: 1.5 };
const READ = { i: [4, 'getInt32'], f: [4, 'getFloat32'], B: [1, 'getUint8'], q: [8, 'getBigInt64'] };

export const isReplay = (name) => /\.bsor$/i.test(name);

const hex = (bytes) => [...bytes].map((b) => b.toString(16).padStart(2, '0')).join(' ');

function python(x) { // a float as Python prints it
  if (!Number.isFinite(x)) return Number.isNaN(x) ? 'nan' : x > 0 ? 'inf' : '-inf';
  return Number.isInteger(x) ? x.toFixed(1) : String(x);
}

class Bytes { // bsor.Bytes: the bytes of a file, read one after the other
  constructor(name, raw, at = 0) {
    Object.assign(this, { name, raw, at, view: new DataView(raw.buffer, raw.byteOffset, raw.byteLength) });
  }

  fault(what, says, valid) {
    return new UserError(`${this.name}, byte ${this.at}, ${what}: ${says}; valid: ${valid}`);
  }

  get left() {
    return this.raw.length - this.at;
  }

  skip(size, what) {
    if (this.left < size) throw this.fault(what, `wants ${size} bytes, and the file has ${this.left} more`, 'a whole file');
    this.at += size;
    return this.at - size;
  }

  number(kind, what) {
    const [size, read] = READ[kind];
    return this.view[read](this.skip(size, what), true);
  }

  count(size, what) {
    const n = this.number('i', what);
    if (!(n >= 0 && n * size <= this.left)) {
      this.at -= 4;
      const most = Math.floor((this.left - 4) / size);
      throw this.fault(what, `a count of ${n}`, `0 to ${most}, which is what the file has room for`);
    }
    return n;
  }

  string(what) {
    const n = this.count(1, `length of the ${what}`);
    if (n > STRING) throw this.fault(what, `a string of ${n} bytes`, `at most ${STRING}`);
    const start = this.skip(n, what);
    return new TextDecoder('utf-8', { ignoreBOM: true }).decode(this.raw.subarray(start, start + n));
  }
}

export class Replay { // bsor.Replay: what a Reader is for a CSV
  constructor(name, raw, devices = 3) {
    Object.assign(this, { name, devices, unreadable: 0, axes: null, pauses: [] });
    const b = new Bytes(name, raw);
    checkStart(b);
    this.info = readInfo(b);
    [this.times, this.poses] = readFrames(b);
    SECTIONS.slice(2).forEach((section, k) => {
      if (!b.left) return; // a file may end before a section, and not in one
      begin(b, k + 2);
      if (section === 'notes') skipNotes(b);
      else if (section === 'pauses') this.pauses = readPauses(b);
      else b.skip(b.count(SIZES[section], section) * SIZES[section], section);
    });
  }

  * samples() {
    const seconds = played(this.times, pace(this.info), this.pauses);
    for (let k = 0; k < seconds.length; k++) {
      const rows = DEVICES.map((_, d) => (d < this.devices ? this.poses(k, d) : Array(PARTS.length).fill(NaN)));
      yield { t: seconds[k], pos: rows.map((r) => r.slice(0, 3)), quat: rows.map((r) => r.slice(3)) };
    }
  }
}

function checkStart(b) { // bsor.check_start
  const first = b.raw.subarray(0, 4);
  if (hex(first) !== hex(MAGIC)) {
    throw b.fault('magic number', `begins with ${hex(first) || 'nothing'}`, `${hex(MAGIC)}, a BSOR's`);
  }
  b.skip(4, 'magic number');
  const version = b.number('B', 'version');
  if (version === VERSION) return;
  b.at -= 1;
  throw b.fault('version', version, VERSION);
}

function begin(b, number) { // bsor.begin: a section begins with its number
  const found = b.number('B', SECTIONS[number]);
  if (found === number) return;
  b.at -= 1;
  throw b.fault(`begin of the ${SECTIONS[number]}`, found, number);
}

function readInfo(b) { // bsor.read_info: the first way to end the strings from which all that follows can be read
  begin(b, 0);
  const ways = [[0, b.at, {}]];
  for (let tried = 0; ways.length && tried < TRIED; tried++) {
    const [k, at, info] = ways.pop();
    if (k === INFO.length) {
      if ((at === b.raw.length || b.raw[at] === 1) && info['left-handed'] <= 1) {
        b.at = at;
        return info;
      }
      continue;
    }
    const [name, kind] = INFO[k];
    const here = new Bytes(b.name, b.raw, at);
    try {
      if (kind === 's') {
        const found = [...ends(here, name)];
        ways.push(...found.reverse().map(([end, text]) => [k + 1, end, { ...info, [name]: text }]));
      } else {
        const value = here.number(kind, name);
        ways.push([k + 1, here.at, { ...info, [name]: value }]);
      }
    } catch (error) {
      if (!(error instanceof UserError)) throw error;
    }
  }
  const info = {};
  for (const [name, kind] of INFO) info[name] = kind === 's' ? b.string(name) : b.number(kind, name);
  if (info['left-handed'] > 1) throw b.fault('info, left-handed', info['left-handed'], '0 or 1');
  return info;
}

function* ends(b, name) { // bsor.ends: where the next string may end, and its text
  const n = b.count(1, name);
  if (n > STRING) return;
  const [start, most] = [b.at, n > NAME ? n : 3 * n];
  const decoder = new TextDecoder('utf-8', { fatal: true, ignoreBOM: true });
  for (let end = start + n; end <= Math.min(start + most, b.raw.length); end++) {
    try {
      yield [end, decoder.decode(b.raw.subarray(start, end))];
    } catch (error) {
      if (!(error instanceof TypeError)) throw error; // no UTF-8
    }
  }
}

function readFrames(b) { // bsor.read_frames: times [s of the song], and the pose of a device in a frame
  begin(b, 1);
  const n = b.count(FRAME, 'frames');
  if (!n) throw b.fault('frames', 'none', 'one or more');
  const start = b.skip(n * FRAME, 'frames');
  const value = (k, i) => b.view.getFloat32(start + k * FRAME + (i ? 4 * i + 4 : 0), true); // i 0: the time
  const numbers = 1 + DEVICES.length * PARTS.length;
  const times = Array.from({ length: n }, (_, k) => value(k, 0));
  for (let k = 0; k < n; k++) {
    for (let i = 0; i < numbers; i++) {
      const x = value(k, i);
      if (Number.isFinite(x)) continue;
      b.at = start + k * FRAME + (i ? 4 * i + 4 : 0);
      const what = i ? `${DEVICES[Math.floor((i - 1) / 7)]} ${PARTS[(i - 1) % 7]}` : 'time';
      throw b.fault(`frame ${k}, ${what}`, python(x), 'a finite number');
    }
  }
  return [times, (k, d) => PARTS.map((_, j) => value(k, 1 + d * PARTS.length + j))];
}

function skipNotes(b) { // bsor.skip_notes: their entries are of two sizes
  const n = b.count(NOTE, 'notes');
  for (let k = 0; k < n; k++) {
    b.skip(NOTE - 4, `note ${k}`);
    if ([0, 1].includes(b.number('i', `note ${k}`))) b.skip(CUT, `cut of note ${k}`);
  }
}

function readPauses(b) { // bsor.read_pauses: [start in the song, duration], each [s]
  const out = [];
  const n = b.count(SIZES.pauses, 'pauses');
  for (let k = 0; k < n; k++) {
    const [duration, start] = [b.number('q', `pause ${k}`), b.number('f', `pause ${k}`)]; // a BigInt, and a number
    if (!(duration >= 0 && duration <= PAUSE && Number.isFinite(start))) {
      b.at -= SIZES.pauses;
      throw b.fault(`pause ${k}`, `${duration} s at ${python(start)} s`, '0 to 1e+06 s, at a finite time');
    }
    out.push([start, Number(duration)]);
  }
  return out.sort((p, q) => p[0] - q[0] || p[1] - q[1]);
}

function pace(info) { // bsor.pace: seconds of the song in one of the player's
  if (info.speed >= 0.1 && info.speed <= 10) return info.speed;
  const said = info.modifiers.split(',').map((m) => m.trim());
  return PACES[said.find((m) => m in PACES)] ?? 1;
}

function played(times, songPace, pauses) { // bsor.played: t = s / pace + Σ duration of the pauses that began before s
  return times.map((s) => pauses.reduce((t, [start, long]) => t + (start < s ? long : 0), s / songPace));
}
