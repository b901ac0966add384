// Runs in the browser: the page's own modules under Python's inputs.  -> numbers for parity.test.js

import { Player } from '../src/player.js';
import { Reader, linesOf } from '../src/reader.js';
import { Simulation, fetchCharacter } from '../src/character.js';
import { Stream } from '../src/calibration.js';
import { loadMujoco } from '../src/mujoco.js';
import { writeBvh } from '../src/bvh.js';

const folder = new URL('data/', import.meta.url);
const furthest = (a, b) => a.reduce((worst, x, i) => Math.max(worst, Math.abs(x - b[i])), 0);

export async function parity(name, expected, text, seconds) {
  const mj = await loadMujoco();
  const sim = new Simulation(mj, await fetchCharacter(folder, `${name}.json`));
  const { start, controls, qpos, qvel } = expected.physics;
  sim.qpos.set(start);
  for (const row of controls) {
    sim.ctrl.set(row);
    mj.mj_step(sim.model, sim.data);
  }
  const out = { qpos: furthest(qpos, sim.qpos), qvel: furthest(qvel, sim.qvel) };
  mj.mj_resetData(sim.model, sim.data);
  const player = new Player(sim);
  const stream = new Stream(sim.table, { axes: 'openxr', devices: player.devices });
  const roots = [];
  const costs = [];
  const when = [];
  const [frames, states] = [[], []];
  loop: for (const sample of new Reader('demo', player.devices).read(linesOf(text))) {
    for (const tick of stream.push(sample)) {
      const before = performance.now();
      const end = player.step(tick);
      costs.push(performance.now() - before);
      if (!roots.length) {
        out.obs = furthest(expected.obs, player.obs);
        out.action = furthest(expected.action, player.action);
      }
      if (end) when.push([roots.length, end]);
      if (frames.length < 90) {
        frames.push({ xpos: sim.xpos.slice(), xquat: sim.xquat.slice() });
        states.push(Array.from(sim.qpos));
      }
      roots.push(Array.from(sim.qpos.subarray(0, 3)));
      if (roots.length >= 30 * seconds) break loop;
    }
  }
  const c = stream.calibration;
  out.calibration = furthest(expected.calibration, [c.height, c.floor, c.yaw, ...c.origin, ...c.scale]);
  out.apart = roots.map((r, i) => Math.hypot(...r.map((x, k) => x - expected.roots[i][k])));
  out.finite = roots.flat().every(Number.isFinite);
  out.ends = { ...player.ends };
  Object.assign(out, { costs, when, states });
  out.bvh = writeBvh(sim.table, sim.body_parentid, sim.body_ipos, frames, 30);
  sim.delete();
  return out;
}

globalThis.parity = parity;
