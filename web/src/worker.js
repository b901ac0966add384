// Physics and policy in a thread of their own, so that the page never freezes.
//
//   page -> worker   load, play, live, sample, leave, and the buttons: pause, reset, recalibrate, speed, push, record
//   worker -> page   loaded, state (after each control step), calibrating, ended, recording, error

import { CALIBRATION, CONTROL_RATE, Stream } from './calibration.js';
import { choose } from './axes.js';
import { Replay, isReplay } from './bsor.js';
import { AXES, COLUMNS, GAP, Reader, UNIT, UserError, linesOf } from './reader.js';
import { Player } from './player.js';
import { Simulation, fetchCharacter, visualShapes } from './character.js';
import { loadMujoco } from './mujoco.js';
import { writeBvh } from './bvh.js';

const PERIOD = 1000 / CONTROL_RATE; // ms
const LATE = 500; // ms: farther behind than that, the clock starts anew
const KEPT = 600 * CONTROL_RATE; // ticks that are recorded at most: ten minutes
const folder = new URL('data/', import.meta.url);

const started = loadMujoco();
let sim = null;
let player = null;
let source = null; // { kind: file or live, stream, … }
let recording = null; // { samples, frames, options }
let [paused, speed] = [false, 1];
let due = 0; // ms, when the next tick of a file is to be played
let [lastSample, lastIdle] = [0, 0]; // ms, of a live headset: its last row, and the last time that none came
let costs = []; // ms of the last control steps

const wall = (now) => performance.timeOrigin + now; // the page's clock
const post = (type, fields = {}, transfer = []) => self.postMessage({ type, ...fields }, transfer);

function fail(error) {
  if (!(error instanceof UserError)) console.error(error);
  post('error', { text: String(error.message || error).split('\n')[0] });
}

// ---------------------------------------------------------------------------------- sources

async function load({ file }) {
  const [mj, character] = await Promise.all([started, fetchCharacter(folder, file)]);
  sim?.delete();
  sim = new Simulation(mj, character);
  const shapes = visualShapes(mj, character.table.xml);
  sim.look(); // the whole model came and went: memory may have moved
  player = new Player(sim);
  recording = null;
  atRest();
  const { name, licence, bodies, root } = character.table;
  post('loaded', { name, licence, bodies: bodies.length, root, shapes, mass: sim.mass });
  show(null, null);
  if (source?.order) play(source.order);
  else if (source) live();
}

function atRest() { // before anything is known of a headset
  const { table } = sim;
  sim.qpos.set([0, 0, table.hip_height, ...table.rest_root, ...table.default]);
  sim.qvel.fill(0);
  sim.refresh();
}

function streamOf(options) {
  const devices = options.alone ? 1 : sim.table.policy.devices;
  return new Stream(sim.table, { ...options, devices });
}

// order : { text, or a file's bytes, name, axes, grip, sampleRate, userHeight, alone, loop }
function play(order) {
  const devices = order.alone ? 1 : sim.table.policy.devices;
  const [reader, samples] = opened(order, devices);
  const first = samples.next(); // the header, and a comment that says which axes
  const options = { ...order, axes: AXES[reader.axes] ? reader.axes : order.axes };
  if (options.axes === 'auto') {
    const found = isReplay(order.name) ? { axes: 'unity', lines: [] } : choose(() => opened(order, devices)[1], devices);
    Object.assign(options, found, { grip: order.grip ?? found.grip });
    post('note', { text: found.lines.map((line) => `${order.name}: ${line}`).join('; ') });
  }
  source = { kind: 'file', order, options, reader, stream: streamOf(options), waiting: [], samples, first };
  begin();
}

function opened({ name, bytes, text }, devices) { // bsor.opened: the reader of a file, and its samples
  if (isReplay(name)) {
    const replay = new Replay(name, bytes, devices);
    return [replay, replay.samples()];
  }
  const reader = new Reader(name, devices);
  return [reader, reader.read(linesOf(text ?? new TextDecoder().decode(bytes)))];
}

function live() {
  const options = { axes: 'openxr' };
  source = { kind: 'live', options, stream: streamOf(options) };
  begin();
}

function begin() {
  player.before = null;
  player.restart();
  atRest();
  costs = [];
  due = performance.now();
  lastSample = due;
  show(null, null);
}

function nextTick() { // of a file; null at its end
  while (!source.waiting.length) {
    const item = source.first || source.samples.next();
    source.first = null;
    if (item.done) return null;
    record(item.value);
    source.waiting.push(...source.stream.push(item.value));
  }
  return source.waiting.shift();
}

function ended() {
  const { order, reader, stream } = source;
  if (!stream.calibration) {
    const why = `${reader.name}: ${stream.uncalibrated()}`;
    source = null;
    throw new UserError(why);
  }
  const unreadable = reader.unreadable ? [`${reader.unreadable} lines could not be read`] : [];
  post('ended', { ticks: player.ticks, ends: player.ends, report: [...stream.guard.report(), ...unreadable] });
  if (order.loop) play(order);
  else source = { ...source, kind: 'over' };
}

// ---------------------------------------------------------------------------------- time

function clock() {
  const now = performance.now();
  let wait = PERIOD / 4;
  try {
    if (source?.kind === 'file' && !paused) {
      if (now - due > LATE) due = now;
      if (now >= due) {
        const tick = nextTick();
        if (tick) step(tick, wall(now));
        else ended();
        due += PERIOD / speed;
      }
      wait = Math.max(0, due - performance.now());
    } else if (source?.kind === 'live') { // reader.arriving: nothing comes, first for GAP, then every PERIOD
      const silent = now - Math.max(lastSample, lastIdle);
      if (silent > (lastIdle > lastSample ? PERIOD : GAP * 1000)) {
        lastIdle = now;
        for (const tick of source.stream.idle(silent / 1000)) step(tick, null);
      }
    } else {
      due = now;
    }
  } catch (error) {
    source = null;
    fail(error);
  }
  setTimeout(clock, wait);
}

function sample({ sample: s, sent }) { // of a live headset
  if (source?.kind !== 'live') return;
  record(s);
  lastSample = performance.now();
  const before = source.stream.calibration;
  for (const tick of source.stream.push(s)) step(tick, sent);
  if (!source.stream.calibration) post('calibrating', { share: Math.min(source.stream.tracked() / CALIBRATION, 1) });
  else if (!before) post('calibrated', { calibration: { ...source.stream.calibration } });
}

function step(tick, sent) {
  if (paused) return; // a live headset goes on, its character does not
  const start = performance.now();
  const end = player.step(tick);
  costs.push(performance.now() - start);
  if (costs.length > 300) costs.shift();
  if (recording && recording.frames.length < KEPT) {
    recording.frames.push({ xpos: sim.xpos.slice(), xquat: sim.xquat.slice() });
  }
  show(tick, sent, end);
}

function show(tick, sent, end = null) {
  const [xpos, xquat] = [sim.xpos.slice(), sim.xquat.slice()];
  post('state', {
    xpos, xquat, sent, end, ticks: player.ticks, ends: { ...player.ends }, sensors: tick && { pos: tick.pos,
      quat: tick.quat }, lost: source?.stream ? source.stream.guard.tracks.map((t) => t.lost) : [],
    cost: costs.at(-1) ?? 0, pull: player.pull && player.pull.target,
  }, [xpos.buffer, xquat.buffer]);
}

// ---------------------------------------------------------------------------------- buttons

function record(s) {
  if (recording && recording.samples.length < 3 * KEPT) recording.samples.push(s);
}

function asCsv({ samples, options }) { // export.as_csv: what headset.reader plays again, devices in order, in the axes' unit
  const { axes, order = [0, 1, 2], unit } = options;
  const size = unit ? unit / (UNIT[axes] ?? 1) : 1;
  const cell = (x) => (Number.isFinite(x) ? String(x) : '');
  const rows = samples.map((s) => [s.t, ...order.flatMap((i) => [...s.pos[i].map((x) => x * size), ...s.quat[i]])].map(cell).join(','));
  return [`# recorded by the page; axes: ${axes}`, COLUMNS.join(','), ...rows].join('\n') + '\n';
}

const handlers = {
  load,
  play,
  live,
  sample,
  leave() { source = null; },
  pause({ on }) { paused = on; },
  speed({ factor }) { speed = factor; },
  recalibrate() {
    if (!source?.stream) return;
    source.stream = streamOf(source.options);
    if (source.waiting) source.waiting = [];
    player.before = null;
  },
  reset() { // stand the character up under the headset, and count anew
    player.before = null;
    player.restart();
  },
  push({ pull }) {
    player.pull = pull;
  },
  record({ on }) {
    if (on) {
      recording = { samples: [], frames: [], options: source?.options || { axes: 'openxr' } };
      return;
    }
    if (!recording) return;
    const bvh = recording.frames.length
      ? writeBvh(sim.table, sim.body_parentid, sim.body_ipos, recording.frames, CONTROL_RATE) : null;
    post('recording', { name: sim.table.name, csv: asCsv(recording), bvh });
    recording = null;
  },
};

let queue = Promise.resolve(); // one message after the other: `load` waits for files
self.onmessage = ({ data }) => {
  const work = async () => {
    if (!sim && data.type !== 'load') return;
    try {
      await handlers[data.type](data);
    } catch (error) {
      fail(error);
    }
  };
  queue = queue.then(work);
};
clock();
