// Axes, unit and order of a file that does not tell them: the same as Python finds.

import assert from 'node:assert/strict';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { test } from 'node:test';
import { choose } from '../src/axes.js';
import { AXES, COLUMNS, Reader, linesOf } from '../src/reader.js';
import { expected, web } from './tools.js';

// The demonstration, in OpenXR's axes, from where it walks.
const demo = readFileSync(join(web, 'dist/data/demo.csv'), 'utf8').trim().split('\n').slice(2)
  .map((line) => line.split(',').map(Number)).slice(150, 850);

const times = (m, v) => m.map((row) => row.reduce((sum, x, k) => sum + x * v[k], 0));
const turned = (m) => m[0].map((_, j) => m.map((row) => row[j]));
const det = (m) => m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
  + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);

// A CSV of it as another system would have written it.
function written(axes, { unit = 1, order = [0, 1, 2], rows = demo, lying = false } = {}) {
  const own = (v) => times(turned(AXES[axes]), times(AXES.openxr, v)); // our x, y, z in between
  const sign = Math.round(det(AXES[axes]) * det(AXES.openxr));
  const lines = rows.map((r) => [r[0], ...order.flatMap((d) => {
    const from = lying && d ? rows[0] : r;
    const [p, q, w] = [from.slice(1 + 7 * d, 4 + 7 * d), from.slice(4 + 7 * d, 7 + 7 * d), from[7 + 7 * d]];
    return [...own(p).map((x) => x / unit), ...own(q).map((x) => sign * x), w];
  })]);
  return `${COLUMNS.join(',')}\n${lines.map((row) => row.join(',')).join('\n')}\n`;
}

const FILES = {
  unity: written('unity'), openxr: written('openxr'), mujoco: written('mujoco'), unreal: written('unreal', { unit: 0.01 }),
  millimetres: written('unity', { unit: 0.001 }), 'hands exchanged': written('openxr', { order: [0, 2, 1] }),
  'headset last': written('unity', { order: [2, 1, 0] }), 'controllers on a table': written('unity', { lying: true }),
  'too short': written('openxr', { rows: demo.slice(0, 20) }), still: written('openxr', { rows: demo.map((r) => [r[0], ...demo[0].slice(1)]) }),
};
const more = (process.env.RECORDINGS || '').split(':').filter((path) => path); // real ones, where there are some

test('axes, grip, unit and order as Python finds them', (t) => {
  const folder = mkdtempSync(join(tmpdir(), 'axes-'));
  const paths = Object.values(FILES).map((text, i) => {
    writeFileSync(join(folder, `${i}.csv`), text);
    return join(folder, `${i}.csv`);
  });
  const wanted = expected('axes', ...paths, ...more);
  [...paths, ...more].forEach((path, i) => {
    const text = readFileSync(path, 'utf8');
    const got = choose(() => new Reader('FILE').read(linesOf(text)));
    assert.deepEqual(got, wanted[i], Object.keys(FILES)[i] ?? path);
    t.diagnostic(`${Object.keys(FILES)[i] ?? path}: ${got.lines[0]}`);
  });
  assert.deepEqual(wanted.slice(0, 4).map((w) => w.axes), ['unity', 'openxr', 'mujoco', 'unreal']);
  rmSync(folder, { recursive: true });
});
