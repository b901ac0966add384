// An emulated Quest 3 (Meta's iwer): enters VR, stands, waves, walks, loses a controller, loses tracking, leaves.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import { browser, open, serve, sleep, until, web } from './tools.js';

let [chrome, server] = [];
before(async () => { [server, chrome] = [await serve(), await browser()]; });
after(async () => { await chrome?.close(); server?.close(); });

const iwer = readFileSync(join(web, 'node_modules/iwer/build/iwer.min.js'), 'utf8');
// headless Chromium has a navigator.xr of its own, without a device: forceInstall takes its place
const setup = `${iwer};
  globalThis.xrd = new IWER.XRDevice(IWER.metaQuest3);
  xrd.installRuntime({ forceInstall: true });`;

// The demonstration moves the emulated devices, from its first row, as long as the page is open.
function wear(text) {
  const rows = text.trim().split('\n').slice(2).map((line) => line.split(',').map(Number));
  const { xrd } = globalThis;
  const start = performance.now();
  setInterval(() => {
    const row = rows[Math.min(Math.floor((performance.now() - start) * 0.06), rows.length - 1)];
    const jitter = () => (Math.random() - 0.5) * 1e-4; // a real device is never quite still
    const place = (device, at) => {
      device.position.set(row[at] + jitter(), row[at + 1] + jitter(), row[at + 2] + jitter());
      device.quaternion.set(...row.slice(at + 3, at + 7));
    };
    place(xrd, 1);
    place(xrd.controllers.left, 8);
    place(xrd.controllers.right, 15);
  }, 8);
}

test('an emulated Quest 3: enter, wave, walk, lose a controller, lose tracking, leave, enter again', async (t) => {
  const { page, faults } = await open(chrome, server.url, { width: 480, height: 270, before: setup });
  await page.goto(server.url);
  await until(page, () => globalThis.app?.firstPicture && !document.getElementById('enter').disabled);
  assert.equal(await page.$eval('#enter', (b) => b.textContent), 'Enter VR');
  const demo = readFileSync(join(web, 'dist/data/demo.csv'), 'utf8');
  await page.evaluate(wear, demo);
  // Software pictures take a fifth of a second each, which the guard takes for drop-outs: none while it counts.
  await page.evaluate(() => { globalThis.app.still = true; });
  await page.click('#enter'); // a real click: a session needs one
  await until(page, () => globalThis.app.calibration, 20_000);
  const { height, scale, floor } = await page.evaluate(() => globalThis.app.calibration);
  t.diagnostic(`calibrated: headset ${height.toFixed(2)} m up, floor at ${floor.toFixed(2)} m, `
    + `heights times ${scale[2].toFixed(3)}`);
  assert.ok(Math.abs(height - 1.67) < 0.03);
  if (process.env.SHOTS) {
    await page.evaluate(() => { globalThis.app.still = false; });
    await sleep(2000);
    await page.screenshot({ path: join(process.env.SHOTS, 'headset.png') });
    await page.evaluate(() => { globalThis.app.still = true; });
  }

  // Does the character follow?  Its root against its headset's place, as long as the devices are tracked.
  const watch = async (seconds) => {
    const gaps = [];
    for (let i = 0; i < seconds * 10; i++) {
      gaps.push(await page.evaluate(() => {
        const { xpos, sensors } = globalThis.app.state;
        return sensors && Math.hypot(xpos[3] - sensors.pos[0][0], xpos[4] - sensors.pos[0][1]);
      }));
      await sleep(100);
    }
    return gaps.filter((x) => x !== null).sort((a, b) => a - b);
  };
  const state = () => page.evaluate(() => ({ lost: globalThis.app.state.lost, ends: globalThis.app.state.ends,
    ticks: globalThis.app.ticks, finite: globalThis.app.finite, z: globalThis.app.state.xpos[5] }));
  const gaps = await watch(8); // stands, waves, walks
  t.diagnostic(`root to headset, horizontally: median ${gaps[gaps.length >> 1].toFixed(2)} m, `
    + `largest ${gaps.at(-1).toFixed(2)} m`);
  assert.ok(gaps[gaps.length >> 1] < 0.5);
  assert.ok(gaps.at(-1) < 1.3); // farther than 1 m it is stood up again

  await page.evaluate(() => { globalThis.xrd.controllers.left.connected = false; });
  await sleep(1000);
  const one = await state();
  assert.equal(one.lost[1], 'not finite', 'a lost controller');
  assert.equal(one.lost[2], null);
  assert.match(await page.$eval('#status', (p) => p.textContent), /not tracked: left controller/);
  await page.evaluate(() => { globalThis.xrd.controllers.left.connected = true; });
  await sleep(600);
  assert.equal((await state()).lost[1], null, 'a controller that came back');

  await page.evaluate(() => {
    const { getViewerPose, getPose } = XRFrame.prototype;
    Object.assign(XRFrame.prototype, { getViewerPose: () => null, getPose: () => null });
    globalThis.found = () => Object.assign(XRFrame.prototype, { getViewerPose, getPose });
  });
  const before = await state();
  await sleep(1000);
  const blind = await state();
  assert.ok(blind.lost.every(Boolean), 'lost tracking');
  assert.ok(blind.ticks > before.ticks + 15, 'the character goes on');
  await page.evaluate(() => globalThis.found());
  await sleep(800);
  assert.deepEqual((await state()).lost, [null, null, null], 'tracking came back');

  await page.evaluate(() => globalThis.xrd.updateVisibilityState('visible-blurred')); // the headset's menu
  await sleep(400);
  await page.evaluate(() => globalThis.xrd.updateVisibilityState('visible'));

  await page.evaluate(() => globalThis.xrd.controllers.right.updateButtonValue('trigger', 1));
  await sleep(300);
  await page.evaluate(() => globalThis.xrd.controllers.right.updateButtonValue('trigger', 0));
  await sleep(300);
  assert.ok((await state()).ticks < before.ticks, 'the trigger stands it up and counts anew');

  const last = await state();
  t.diagnostic(`in VR: ${JSON.stringify(last.ends)}; ${await page.$eval('#status', (p) => p.textContent)}`);
  assert.ok(last.finite, 'nothing is NaN');
  await page.evaluate(() => globalThis.xrd.activeSession.end());
  await until(page, () => document.getElementById('status').textContent.startsWith('Demonstration'), 10_000);
  assert.equal(await page.$eval('#enter', (b) => b.textContent), 'Enter VR');

  await page.evaluate(() => { globalThis.app.calibration = null; });
  await page.click('#enter');
  await until(page, () => globalThis.app.calibration, 20_000);
  await page.evaluate(() => globalThis.xrd.recenter()); // the origin moves: the page measures anew
  await sleep(1500);
  assert.ok((await state()).finite);
  assert.deepEqual(faults, []);
  await page.close();
});
