// The page: what the visitor clicks, what comes from the headset, what is drawn.

import { View } from './scene.js';
import { Panel, sampleOf, supported } from './xr.js';

const $ = (id) => document.getElementById(id);
const folder = new URL('data/', import.meta.url);
const BIGGEST = 300e6; // bytes of a recording
const MIRROR = 0.95; // m from the user to the mirror

const app = { falls: 0, ticks: 0, end: null, ready: false, error: null }; // for the console and the tests
globalThis.app = app;

// The worker first: it fetches and compiles MuJoCo while the picture is set up.
const worker = new Worker(new URL('./worker.js', import.meta.url), { type: 'module' });
const view = new View($('picture'));
const panel = new Panel();
view.scene.add(panel.mesh);
const send = (type, fields = {}) => worker.postMessage({ type, ...fields });
Object.assign(app, { send, view });

let character = null; // what the worker told of it
let [characters, demo] = [[], null];
let [session, calibration, calibrating] = [null, null, 0];
let [paused, slow, recording] = [false, false, false];
let pull = null;
let mode = 'demo'; // demo, file, live
let fileName = '';

// ---------------------------------------------------------------------------------- words

const capital = (name) => name[0].toUpperCase() + name.slice(1);
const KIND = { jesse: 'human', oppy: 'mouse', dino: 'dinosaur' };

function say(text) { // one clear line, or none
  app.error = text || null;
  $('message').textContent = text || '';
  $('message').hidden = !text;
}

const frames = { count: 0, since: performance.now(), rate: 0 };
const delays = [];

function statusLine() {
  if (!app.state) return 'Loading …';
  const { ends, ticks } = app.state;
  const times = (n, one, many) => `${n} ${n === 1 ? one : many}`;
  const what = { demo: 'Demonstration', file: fileName, live: 'Your headset' }[mode];
  const parts = [`${what}${paused ? ', paused' : ''}: ${(ticks / 30).toFixed(0)} s`, times(ends.fall, 'fall', 'falls')];
  if (ends.away) parts.push(`lost the user ${times(ends.away, 'time', 'times')}`);
  if (ends.bad) parts.push(`${ends.bad} diverged`);
  const sorted = [...delays].sort((a, b) => a - b);
  if (sorted.length) parts.push(`latency ${sorted[sorted.length >> 1].toFixed(0)} ms`);
  parts.push(`${times(Math.round(frames.rate), 'picture', 'pictures')}/s`);
  const lost = ['headset', 'left controller', 'right controller'].filter((_, i) => app.state.lost[i]);
  if (lost.length && app.state.sensors) parts.push(`not tracked: ${lost.join(', ')}`);
  return parts.join(' · ');
}

function refreshWords() {
  $('who').textContent = character ? capital(character.name) : '…';
  $('pause').textContent = paused ? 'Go on' : 'Pause';
  $('pause').setAttribute('aria-pressed', paused);
  $('slow').setAttribute('aria-pressed', slow);
  $('slow').disabled = mode === 'live';
  $('record').textContent = recording ? 'Stop recording' : 'Record';
  $('record').setAttribute('aria-pressed', recording);
  $('demo').hidden = mode === 'demo';
  for (const b of $('picker').children) b.setAttribute('aria-checked', b.dataset.name === app.picked);
}

// ---------------------------------------------------------------------------------- from the worker

const heard = {
  loaded(m) {
    character = m;
    app.ready = true;
    view.build(m.shapes);
    const harm = /noncommercial/i.test(m.licence) ? 'not for commercial use' : 'free to use';
    $('terms').textContent = `${capital(m.name)}'s policy: ${harm}; whose motion it learnt from is in the small print.`;
    $('licence').textContent = `${capital(m.name)}'s policy: ${m.licence}.`;
    refreshWords();
  },
  state(m) {
    app.state = m;
    app.ticks = m.ticks;
    app.falls = m.ends.fall;
    app.finite = (app.finite ?? true) && m.xpos.every(Number.isFinite) && m.xquat.every(Number.isFinite);
    app.costs = [...(app.costs || []), m.cost].slice(-3000);
    if (m.sent) delays.push(clock() - m.sent);
    if (delays.length > 60) delays.shift();
    if (!m.sensors || view.states.length === 0) view.height = heightOf(m);
    view.take(m, performance.now());
    $('calibrating').hidden = true;
    calibrating = 0;
  },
  calibrating({ share }) {
    calibrating = share;
    $('calibrating').hidden = false;
    $('calibrating').textContent = 'Stand straight, arms hanging, and look ahead for a second …';
  },
  calibrated(m) {
    calibration = m.calibration;
    app.calibration = calibration;
    if (session) view.headsetPlaces(calibration, MIRROR);
  },
  ended(m) {
    app.end = m;
    if (mode === 'file') say('');
    const told = [app.note, m.report.length ? `${fileName}: ${m.report.join('; ')}` : ''].filter((line) => line);
    if (mode === 'file' && told.length) $('note').textContent = told.join(' · ');
  },
  note({ text }) { // how a file is read
    app.note = text;
    if (text) $('note').textContent = text;
  },
  recording({ name, csv, bvh }) {
    const box = $('downloads');
    for (const a of box.querySelectorAll('a')) URL.revokeObjectURL(a.href);
    const files = [['headset.csv', csv, 'what the headset sent'], [`${name}.bvh`, bvh, 'what the character did']];
    box.replaceChildren('Recorded: ', ...files.filter((f) => f[1]).flatMap(([file, text, what]) => {
      const link = Object.assign(document.createElement('a'), { download: file, textContent: `${file} (${what})` });
      link.href = URL.createObjectURL(new Blob([text], { type: 'text/plain' }));
      return [link, '  '];
    }));
    box.hidden = false;
    app.recorded = { csv, bvh };
  },
  error: ({ text }) => say(text),
};

const heightOf = (m) => Math.max(...Array.from({ length: character.bodies }, (_, b) => m.xpos[3 * b + 2])) + 0.15;
const clock = () => performance.timeOrigin + performance.now(); // the worker's is counted from another moment

worker.onmessage = ({ data }) => heard[data.type](data);
worker.onerror = (event) => say(`The simulation stopped: ${event.message || 'this browser cannot run it'}`);

// ---------------------------------------------------------------------------------- sources

function pick(name) {
  const entry = characters.find((c) => c.name === name) || characters[0];
  app.picked = entry.name;
  app.ready = false;
  history.replaceState(null, '', `#${entry.name}`);
  send('load', { file: entry.file });
  refreshWords();
}

function playDemo() {
  mode = 'demo';
  say('');
  app.end = null;
  send('play', { text: demo, name: 'demonstration', axes: 'openxr', loop: true });
  refreshWords();
}

const number = (id) => ($(id).value === '' ? null : Number($(id).value));

async function playFile(file) {
  say('');
  if (file.size > BIGGEST) {
    say(`${file.name}: ${(file.size / 1e6).toFixed(0)} MB; valid: at most ${BIGGEST / 1e6} MB`);
    return;
  }
  const bytes = new Uint8Array(await file.arrayBuffer());
  const fields = [['rate', 'rows a second'], ['height', "headset's height"]];
  const wrong = fields.find(([id]) => number(id) !== null && !(number(id) > 0));
  if (wrong) {
    say(`${wrong[1]} ${$(wrong[0]).value}: valid: a number greater than 0`);
    return;
  }
  [mode, fileName, app.end, app.note] = ['file', file.name, null, ''];
  send('play', {
    bytes, name: file.name, axes: $('axes').value, grip: number('grip'), sampleRate: number('rate') ?? undefined,
    userHeight: number('height'), alone: $('alone').checked,
  });
  refreshWords();
}

// ---------------------------------------------------------------------------------- the headset

async function enter() {
  say('');
  if (session) {
    await session.end();
    return;
  }
  try {
    session = await navigator.xr.requestSession('immersive-vr', { requiredFeatures: ['local-floor'] });
  } catch (error) {
    say(`The headset did not start: ${error.message}`);
    return;
  }
  session.addEventListener('end', leave);
  session.addEventListener('select', () => send('reset')); // trigger
  session.addEventListener('squeezestart', () => recalibrate());
  [mode, calibration, slow, paused] = ['live', null, false, false];
  send('speed', { factor: 1 });
  send('pause', { on: false });
  send('live');
  panel.mesh.visible = true;
  view.renderer.xr.setReferenceSpaceType('local-floor');
  await view.renderer.xr.setSession(session);
  // The user moved the origin: every pose jumps, and what was measured holds no longer.
  view.renderer.xr.getReferenceSpace().addEventListener('reset', () => recalibrate());
  $('enter').textContent = 'Leave VR';
  refreshWords();
}

function leave() {
  session = null;
  panel.mesh.visible = false;
  send('leave');
  view.screenPlaces();
  view.camera.position.set(-1.6, 1.5, -3.6);
  view.controls.target.set(0, 0, 0);
  $('enter').textContent = 'Enter VR';
  $('calibrating').hidden = true;
  resize();
  playDemo();
}

function recalibrate() {
  panel.mesh.visible = Boolean(session);
  send('recalibrate');
}

function headsetFrame(frame, time) {
  const space = view.renderer.xr.getReferenceSpace();
  if (!space) return;
  const visible = session.visibilityState !== 'hidden';
  if (visible) send('sample', { sample: sampleOf(frame, time, space, session.inputSources), sent: clock() });
  const waits = !calibration || calibrating > 0;
  if (waits) panel.before(view.renderer.xr.getCamera(), 1.6);
  panel.write(waits ? ['Stand straight, look ahead', 'Arms hanging, for one second']
    : [capital(character.name), statusLine().split(' · ').slice(1, 3).join(', '),
      'trigger: stand up   grip: measure me anew']);
  if (!waits) panel.mesh.position.y = 0.35 + calibration.floor;
  view.lightActor(character.root);
}

// ---------------------------------------------------------------------------------- pictures

function draw(time, frame) {
  const now = performance.now();
  view.pose(now);
  if (session && frame) {
    headsetFrame(frame, time);
  } else if (character) {
    view.follow(character.root, now);
    view.showRope(pull);
  }
  if (!app.still) view.renderer.render(view.scene, view.camera);
  if (character && !app.firstPicture && view.states.length) app.firstPicture = performance.now();
  frames.count += 1;
  if (now - frames.since > 500) {
    frames.rate = (1000 * frames.count) / (now - frames.since);
    [frames.count, frames.since] = [0, now];
    $('status').textContent = statusLine();
  }
}

// ---------------------------------------------------------------------------------- clicks

$('enter').onclick = enter;
$('pause').onclick = () => { paused = !paused; send('pause', { on: paused }); refreshWords(); };
$('reset').onclick = () => send('reset');
$('recalibrate').onclick = recalibrate;
$('slow').onclick = () => { slow = !slow; send('speed', { factor: slow ? 0.25 : 1 }); refreshWords(); };
$('record').onclick = () => { recording = !recording; send('record', { on: recording }); refreshWords(); };
$('demo').onclick = playDemo;
$('file').onchange = (event) => {
  if (event.target.files[0]) playFile(event.target.files[0]);
  event.target.value = '';
};

addEventListener('dragover', (event) => { event.preventDefault(); $('drop').hidden = false; });
addEventListener('dragleave', (event) => { if (!event.relatedTarget) $('drop').hidden = true; });
addEventListener('drop', (event) => {
  event.preventDefault();
  $('drop').hidden = true;
  const file = event.dataTransfer.files[0];
  if (file) playFile(file);
});
function resize() { // the panels lie over the picture
  const [above, below] = [document.querySelector('header'), document.querySelector('footer')]
    .map((panel) => panel.getBoundingClientRect());
  const beside = above.width < 0.5 * window.innerWidth;
  const [left, top] = beside ? [above.right, 0] : [0, above.bottom];
  view.resize({ left, right: window.innerWidth, top, bottom: below.top });
}
addEventListener('resize', resize);
for (const panel of document.querySelectorAll('header, footer')) new ResizeObserver(resize).observe(panel);

// A drag that begins on the character pulls it; one that begins beside it turns the camera.
const canvas = $('picture');
canvas.addEventListener('pointerdown', (event) => {
  const hit = session ? null : view.hit(event.clientX, event.clientY);
  if (!hit) return;
  view.controls.enabled = false;
  event.stopImmediatePropagation();
  canvas.setPointerCapture(event.pointerId);
  pull = { ...hit, target: view.inPlane(event.clientX, event.clientY, hit.point) };
}, { capture: true });
canvas.addEventListener('pointermove', (event) => {
  if (!pull) return;
  pull.target = view.inPlane(event.clientX, event.clientY, pull.point) ?? pull.target;
  send('push', { pull: { body: pull.body, at: pull.at, target: pull.target } });
});
const letGo = () => {
  if (!pull) return;
  pull = null;
  view.controls.enabled = true;
  send('push', { pull: null });
};
for (const type of ['pointerup', 'pointercancel']) canvas.addEventListener(type, letGo);

// ---------------------------------------------------------------------------------- start

async function start() {
  resize();
  const get = async (file) => {
    const answer = await fetch(new URL(file, folder), { cache: 'no-cache' });
    if (!answer.ok) throw new Error(`${file}: not found (${answer.status}); build the page again`);
    return answer;
  };
  const text = get('demo.csv').then((answer) => answer.text());
  characters = (await (await get('index.json')).json()).characters;
  for (const { name } of characters) {
    const button = Object.assign(document.createElement('button'), { textContent: capital(name) });
    Object.assign(button.dataset, { name });
    button.setAttribute('role', 'radio');
    const kind = document.createElement('small');
    kind.textContent = KIND[name] || '';
    button.append(kind);
    button.onclick = () => pick(name);
    $('picker').append(button);
  }
  pick(location.hash.slice(1));
  view.renderer.setAnimationLoop(draw);
  demo = await text;
  playDemo();
  const vr = await supported();
  $('enter').disabled = !vr;
  $('enter').textContent = vr ? 'Enter VR' : 'VR: open in a headset';
}

start().catch((error) => say(error.message));
