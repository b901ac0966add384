// The page as a visitor has it: the demonstration, a broken file, buttons, pictures.

import assert from 'node:assert/strict';
import { mkdirSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import { CHARACTERS, browser, expected, open, percentile, serve, sleep, until, web } from './tools.js';

let [chrome, server] = [];
const folder = mkdtempSync(join(tmpdir(), 'files-'));
before(async () => { [server, chrome] = [await serve(), await browser()]; });
after(async () => { await chrome?.close(); server?.close(); rmSync(folder, { recursive: true }); });

const ready = (page) => until(page, () => globalThis.app?.ready && globalThis.app.firstPicture);

test('a first picture soon, and how long a step takes', async (t) => {
  const { page, faults } = await open(chrome, server.url);
  await page.goto(server.url);
  await ready(page);
  const first = await page.evaluate(() => globalThis.app.firstPicture);
  t.diagnostic(`first picture after ${(first / 1000).toFixed(2)} s (aim: below 3 s)`);
  assert.ok(first < 10_000);
  const words = await page.evaluate(() => document.body.innerText);
  assert.match(words, /Be\s+Jesse/);
  await until(page, () => globalThis.app.ticks > 30);
  assert.match(await page.$eval('#status', (p) => p.textContent), /Demonstration: \d+ s · \d+ falls?/);
  assert.deepEqual(faults, []);
  await page.close();
});

for (const name of CHARACTERS) {
  test(`${name} plays 20 s of the demonstration`, async (t) => {
    const { page, faults } = await open(chrome, server.url, { width: 240, height: 180 });
    await page.goto(`${server.url}#${name}`);
    await ready(page);
    await page.evaluate(() => { globalThis.app.still = true; }); // software pictures take the cores that physics needs
    await until(page, () => globalThis.app.ticks >= 600, 90_000);
    const { ends, finite, costs } = await page.evaluate(() => (
      { ends: globalThis.app.state.ends, finite: globalThis.app.finite, costs: globalThis.app.costs }));
    const [p50, p99] = [0.5, 0.99].map((share) => percentile(costs, share).toFixed(1));
    t.diagnostic(`${name}: ${ends.fall} falls, ${ends.away} times lost the user, ${ends.bad} diverged; `
      + `control step in the worker p50 ${p50} ms, p99 ${p99} ms (aim: below 10 ms)`);
    assert.ok(finite);
    assert.deepEqual(ends, { fall: 0, away: 0, bad: 0 });
    assert.deepEqual(faults, []);
    await page.close();
  });
}

async function drop(page, name, text) { // as a mouse does it
  await page.evaluate((file, content) => {
    const data = new DataTransfer();
    data.items.add(new File([content], file));
    const options = { dataTransfer: data, cancelable: true };
    for (const type of ['dragover', 'drop']) dispatchEvent(new DragEvent(type, options));
  }, name, text);
}

test('a dropped file: a broken one gives one clear line, a good one plays', async (t) => {
  const { page, faults } = await open(chrome, server.url);
  await page.goto(server.url);
  await ready(page);
  const message = () => page.evaluate(() => (document.getElementById('message').hidden ? ''
    : document.getElementById('message').textContent));
  const demo = readFileSync(join(web, 'dist/data/demo.csv'), 'utf8').split('\n');
  const files = { 'picture.csv': '\u0089PNG\r\n\u001a\n\0\0', 'empty.csv': '', 'empty.bsor': '', 'word.csv': [...demo.slice(0, 50),
    demo[50].replace(/,[^,]*,/, ',oops,'), ...demo.slice(51, 90), ''].join('\n') };
  for (const [name, text] of Object.entries(files)) {
    await drop(page, name, text);
    await until(page, (n) => document.getElementById('message').textContent.startsWith(n), 10_000, name);
    const line = await message();
    t.diagnostic(line.slice(0, 130));
    assert.ok(line.startsWith(name) && !line.includes('\n'));
  }
  await drop(page, 'good.csv', demo.slice(0, 400).join('\n'));
  await until(page, () => /^good\.csv: [2-9] s/.test(document.getElementById('status').textContent), 30_000);
  assert.equal(await message(), '');
  await until(page, () => globalThis.app.end, 60_000);
  assert.deepEqual(faults, []);
  await page.close();
});

test('buttons: pause, slow motion, push, record, stand up, another character', async (t) => {
  const { page, faults } = await open(chrome, server.url, { width: 700, height: 700 });
  await page.goto(server.url);
  await ready(page);
  await until(page, () => globalThis.app.ticks > 10);
  const ticks = () => page.evaluate(() => globalThis.app.ticks);
  const click = (id) => page.click(`#${id}`);

  await click('pause');
  await sleep(300);
  const still = await ticks();
  await sleep(500);
  assert.equal(await ticks(), still, 'pause');
  await click('pause');

  await click('slow');
  await sleep(200);
  const slow = await ticks();
  await sleep(2000);
  const passed = (await ticks()) - slow;
  assert.ok(passed >= 8 && passed <= 22, `slow motion: ${passed} ticks in 2 s`);
  await click('slow');

  await click('record');
  await sleep(2500);
  await click('record');
  await until(page, () => globalThis.app.recorded);
  const { csv, bvh } = await page.evaluate(() => globalThis.app.recorded);
  const links = await page.evaluate(() => [...document.querySelectorAll('#downloads a')].map((a) => a.download));
  assert.deepEqual(links, ['headset.csv', 'jesse.bvh']);
  mkdirSync(folder, { recursive: true });
  writeFileSync(join(folder, 'headset.csv'), csv);
  writeFileSync(join(folder, 'jesse.bvh'), bvh);
  const [played] = expected('stream', join(folder, 'headset.csv'));
  assert.ok(played.ticks?.length > 10, played.error);
  const motion = expected('bvh', join(folder, 'jesse.bvh'));
  assert.equal(motion.names[0], 'pelvis');
  assert.ok(motion.frames > 30);
  t.diagnostic(`recorded: ${csv.split('\n').length - 3} rows, which Python reads as ${played.ticks.length} ticks; `
    + `BVH of ${motion.names.length} joints, ${motion.frames} frames`);

  // Drag the character's root, wherever it is on the screen; it walks, so a first try may miss.
  let pulled = false;
  for (let i = 0; i < 5 && !pulled; i++) {
    const [x, y] = await page.evaluate(() => {
      const { x: across, y: up } = globalThis.app.view.rootOf(1).project(globalThis.app.view.camera);
      return [((across + 1) * innerWidth) / 2, ((1 - up) * innerHeight) / 2];
    });
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.mouse.move(x + 120, y, { steps: 6 });
    await sleep(500);
    pulled = await page.evaluate(() => Boolean(globalThis.app.state.pull));
    await page.mouse.up();
  }
  assert.ok(pulled, 'a drag pulls the character');
  await until(page, () => !globalThis.app.state.pull, 5000);

  await click('reset');
  await until(page, () => globalThis.app.ticks < 30);
  await page.click('#picker button[data-name="dino"]');
  await until(page, () => globalThis.app.ready && document.getElementById('who').textContent === 'Dino');
  await until(page, () => globalThis.app.ticks > 10);
  const shown = await page.evaluate(() => document.getElementById('licence').textContent);
  assert.match(shown, /Dino's policy: .+/);
  assert.deepEqual(faults, []);
  await page.close();
});
