// Reader, clock, guard, calibration and resampler against Python, on recordings with everything that goes wrong.

import assert from 'node:assert/strict';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { test } from 'node:test';
import { quatMatrix } from '../src/human.js';
import { COLUMNS, Reader, linesOf } from '../src/reader.js';
import { Replay } from '../src/bsor.js';
import { Stream } from '../src/calibration.js';
import { expected, web } from './tools.js';

const demo = readFileSync(join(web, 'dist/data/demo.csv'), 'utf8').trim().split('\n').slice(2)
  .map((line) => line.split(',').map(Number));
const table = JSON.parse(readFileSync(join(web, 'dist/data/jesse.json'), 'utf8'));

const csv = (rows, names = COLUMNS) => `${names.join(',')}\n${rows.map((r) => r.join(',')).join('\n')}\n`;
const copy = (n = 600) => demo.slice(0, n).map((r) => [...r]);
const between = (rows, a, b, change) => rows.map((r) => (r[0] >= a && r[0] < b ? change(r) ?? r : r));
const blank = (r, device, value = '') => { r.fill(value, 1 + 7 * device, 8 + 7 * device); };

const OTHER = COLUMNS.map((c) => c.replace('head_p', 'hmd_pos_').replace('_q', '_rot_'));

const WORDS = COLUMNS.map((c) => c.replace(/^(left|right)_p/, '$1 Hand.Position.').replace(/^(left|right)_q/, '$1Controller-Rotation ')
  .replace('head_p', 'HMD pos ').replace('head_q', 'Head_Orientation_').toUpperCase());
const MATRICES = ['t', ...['hmd', 'left', 'right'].flatMap((d) => [0, 1, 2].flatMap((i) => [0, 1, 2, 3].map((j) => `${d}_m${i}${j}`)))];
const asMatrices = (r) => [r[0], ...[0, 1, 2].flatMap((d) => {
  const [px, py, pz, ...q] = r.slice(1 + 7 * d, 8 + 7 * d);
  const [x, y, z, w] = q.map((v) => v / Math.hypot(...q)); // the file has rounded ones
  const m = quatMatrix([w, x, y, z]);
  return [...m.slice(0, 3), px, ...m.slice(3, 6), py, ...m.slice(6, 9), pz];
})];

const GOOD = {
  plain: csv(copy()),
  'controller lost for two seconds': csv(between(copy(), 3, 5, (r) => blank(r, 1))),
  'controller never there': csv(copy().map((r) => { blank(r, 2, 'nan'); return r; })),
  'headset lost': csv(between(copy(), 4, 4.6, (r) => blank(r, 0, 0))),
  'drop-out': csv(copy().filter((r) => r[0] < 3 || r[0] > 3.8)),
  frozen: csv(between(copy(), 5, 7, (r) => { for (let k = 15; k < 22; k++) r[k] = demo[300][k]; })),
  teleport: csv(between(copy(), 5, 99, (r) => { r[1] += 3; r[8] += 3; r[15] += 3; })),
  glitch: csv(between(copy(), 6, 6.05, (r) => { r[8] += 0.8; })),
  'step of the head': csv(between(copy(), 6, 99, (r) => { r[3] += 0.4; })),
  'times out of order': csv(copy().map((r, i) => { if (i % 50 === 9) r[0] -= 0.5; return r; })),
  'another clock': csv(copy().map((r, i) => { if (i > 300) r[0] += 1000; return r; })),
  'no times': csv(copy().map((r) => r.slice(1)), COLUMNS.slice(1)),
  'other names, BOM, CRLF': `\ufeff${csv(copy(), OTHER)}`.replaceAll('\n', '\r\n'),
  'names in words': csv(copy(), WORDS),
  'poses as matrices': csv(copy().map(asMatrices), MATRICES),
  'milliseconds by name': csv(copy().map((r) => [r[0] * 1000, ...r.slice(1)]), ['delta_time_ms', ...COLUMNS.slice(1)]),
  'last line cut short': `${csv(copy())}10.0,0.1,0.`,
  'floor elsewhere': csv(copy().map((r) => { for (const k of [2, 9, 16]) r[k] += 3; return r; })),
};
const BROKEN = {
  empty: '',
  'no columns': 'a,b,c\n1,2,3\n',
  'a column missing': csv(copy(5).map((r) => r.slice(0, -1)), COLUMNS.slice(0, -1)),
  'a column twice': csv(copy(5).map((r) => [...r, 1]), [...COLUMNS, 'head_px']),
  semicolons: csv(copy(5)).replaceAll(',', ';'),
  'a word in a cell': csv(between(copy(), 1, 1.01, (r) => { r[5] = 'oops'; })),
  'cells missing': csv(between(copy(), 1, 1.01, (r) => r.slice(3))),
  milliseconds: csv(copy().map((r) => { r[0] *= 1000; return r; })),
  backwards: csv(copy().reverse()),
  'too short': csv(copy(20)),
  centimetres: csv(copy().map((r) => { for (const k of [1, 2, 3]) r[k] *= 1000; return r; })),
  'old Mac line ends': csv(copy(5)).replaceAll('\n', '\r'),
};

// A replay of Beat Saber, written from the format's public description.
function replay({ rows = copy(300), strings = {}, numbers = {}, notes = [0, 2, 1, 3], pauses = [], sections = 6 } = {}) {
  const [i4, f4] = [4, 4].map((n, k) => (x) => {
    const b = Buffer.alloc(n);
    return k ? (b.writeFloatLE(x), b) : (b.writeInt32LE(x), b);
  });
  const text = ([said, length = Buffer.byteLength(said)]) => Buffer.concat([i4(length), Buffer.from(said)]);
  const names = ['0.5.4', '1.20', '1662541830', '7', 'Alice', 'steam', 'OpenVR', 'Index', 'Knuckles', 'A'.repeat(40), 'Song', 'Me',
    'Expert'].map((word, k) => text(strings[k] ?? [word]));
  const { hands = 0, speed = 0 } = numbers;
  const info = [...names, i4(8123), text(['Standard']), text(['First']), text(strings.modifiers ?? ['']), f4(18.5),
    Buffer.from([hands]), ...[1.7, 0, 0, speed].map(f4)];
  const frames = rows.map((r) => Buffer.concat([f4(r[0]), i4(90), ...r.slice(1).map(f4)]));
  const events = notes.map((kind, k) => Buffer.concat([i4(20113), f4(k), f4(k), i4(kind), Buffer.alloc(kind < 2 ? 72 : 0)]));
  const stops = pauses.map(([start, long]) => {
    const b = Buffer.alloc(12);
    b.writeBigInt64LE(BigInt(long));
    b.writeFloatLE(start, 8);
    return b;
  });
  const bodies = [info, [i4(frames.length), ...frames], [i4(events.length), ...events], [i4(1), Buffer.alloc(16)],
    [i4(2), Buffer.alloc(16)], [i4(stops.length), ...stops]];
  return Buffer.concat([Buffer.from([0x69, 0x3d, 0x2d, 0x44, 1]),
    ...bodies.slice(0, sections).flatMap((body, k) => [Buffer.from([k]), ...body])]);
}

const changed = (raw, at, value) => { const out = Buffer.from(raw); out[at] = value; return out; };
const REPLAYS = {
  'a replay': replay(),
  'two pauses, slower by a modifier': replay({ pauses: [[1, 1], [2.5, 3]], strings: { modifiers: ['NF,SS'] } }),
  practised: replay({ numbers: { speed: 1.5 }, notes: [] }),
  "a name's length in UTF-16": replay({ strings: { 4: ['Jürgen 猫', 8] } }),
  'the frames alone': replay({ sections: 2 }),
};
const BROKEN_REPLAYS = {
  'no replay': Buffer.from('time,head_px\n0,1\n'),
  nothing: Buffer.alloc(0),
  'another version': changed(replay(), 4, 9),
  'a count too large': changed(replay({ sections: 2 }), replay({ sections: 1 }).length + 4, 9),
  'no frames': replay({ rows: [] }),
  'a number that is none': replay({ rows: between(copy(300), 1, 1.01, (r) => { r[9] = NaN; }) }),
  'a time that is none': replay({ rows: between(copy(300), 1, 1.01, (r) => { r[0] = Infinity; }) }),
  'neither hand': replay({ numbers: { hands: 7 } }),
  'a pause before time': replay({ pauses: [[2, -5]] }),
  'another section': changed(replay(), replay({ sections: 2 }).length, 5),
  'cut in a frame': replay().subarray(0, 900),
  'cut in the notes': replay().subarray(0, replay({ sections: 3 }).length - 9),
  'cut in the info': replay().subarray(0, 60),
};

const folder = mkdtempSync(join(tmpdir(), 'streams-'));
const write = (text, i) => {
  const name = join(folder, `${i}.${typeof text === 'string' ? 'csv' : 'bsor'}`);
  writeFileSync(name, text);
  return name;
};

function ticksOf(text) {
  const stream = new Stream(table);
  const ticks = [];
  try {
    const samples = typeof text === 'string' ? new Reader('FILE').read(linesOf(text)) : new Replay('FILE', text).samples();
    for (const sample of samples) ticks.push(...stream.push(sample));
  } catch (error) {
    return { error: error.message };
  }
  if (!stream.calibration) return { error: `FILE: ${stream.uncalibrated()}` };
  return { ticks: ticks.map((tick) => [...tick.pos.flat(), ...tick.quat.flat()]) };
}

test('the same ticks as Python, whatever goes wrong', (t) => {
  const all = { ...GOOD, ...REPLAYS };
  const wanted = expected('stream', ...Object.values(all).map(write));
  Object.keys(all).forEach((name, i) => {
    const got = ticksOf(all[name]);
    assert.equal(got.error, wanted[i].error, name);
    assert.equal(got.ticks.length, wanted[i].ticks.length, name);
    let worst = 0;
    const apart = (k) => (x, c) => { worst = Math.max(worst, Math.abs(x - wanted[i].ticks[k][c])); };
    got.ticks.forEach((row, k) => row.forEach(apart(k)));
    assert.ok(worst < 1e-9, `${name}: ${worst}`);
    t.diagnostic(`${name}: ${got.ticks.length} ticks, ${worst.toExponential(1)}`);
  });
});

test('one clear line for a broken file, the same as Python', (t) => {
  const words = (text) => text.replace(/--sample-rate/, 'the sample rate')
    .replace(/--sensors hmd needs the headset's alone/, '"headset alone" needs the headset\'s only');
  const all = { ...BROKEN, ...BROKEN_REPLAYS };
  const wanted = expected('stream', ...Object.values(all).map(write));
  Object.keys(all).forEach((name, i) => {
    const got = ticksOf(all[name]);
    assert.equal(got.error, words(wanted[i].error ?? 'none'), name);
    assert.ok(!got.error.includes('\n'));
    t.diagnostic(got.error.slice(0, 110));
  });
  rmSync(folder, { recursive: true });
});
