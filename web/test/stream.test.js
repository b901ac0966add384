// Reader, clock, guard, calibration and resampler against Python, on recordings with everything that goes wrong.

import assert from 'node:assert/strict';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { test } from 'node:test';
import { quatMatrix } from '../src/human.js';
import { COLUMNS, Reader, linesOf } from '../src/reader.js';
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

const folder = mkdtempSync(join(tmpdir(), 'streams-'));
const write = (text, i) => {
  writeFileSync(join(folder, `${i}.csv`), text);
  return join(folder, `${i}.csv`);
};

function ticksOf(text) {
  const stream = new Stream(table);
  const ticks = [];
  try {
    for (const sample of new Reader('FILE').read(linesOf(text))) ticks.push(...stream.push(sample));
  } catch (error) {
    return { error: error.message };
  }
  if (!stream.calibration) return { error: `FILE: ${stream.uncalibrated()}` };
  return { ticks: ticks.map((tick) => [...tick.pos.flat(), ...tick.quat.flat()]) };
}

test('the same ticks as Python, whatever goes wrong', (t) => {
  const wanted = expected('stream', ...Object.values(GOOD).map(write));
  Object.keys(GOOD).forEach((name, i) => {
    const got = ticksOf(GOOD[name]);
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
  const wanted = expected('stream', ...Object.values(BROKEN).map(write));
  Object.keys(BROKEN).forEach((name, i) => {
    const got = ticksOf(BROKEN[name]);
    assert.equal(got.error, words(wanted[i].error ?? 'none'), name);
    assert.ok(!got.error.includes('\n'));
    t.diagnostic(got.error.slice(0, 110));
  });
  rmSync(folder, { recursive: true });
});
