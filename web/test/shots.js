// node test/shots.js FOLDER: pictures of the page, to look at, and README's.

import { join } from 'node:path';
import { browser, open, serve, sleep, until, CHARACTERS } from './tools.js';

const folder = process.argv[2] || '.';
const [server, chrome] = [await serve(), await browser()];
for (const name of CHARACTERS) {
  for (const [kind, width, height] of [['desktop', 1280, 720], ['phone', 390, 844]]) {
    const { page, faults } = await open(chrome, server.url, { width, height });
    await page.goto(`${server.url}#${name}`);
    await until(page, () => globalThis.app?.firstPicture && globalThis.app.ticks > 60);
    await sleep(1200);
    await page.screenshot({ path: join(folder, `${name}-${kind}.png`) });
    if (faults.length) console.log(name, kind, faults);
    await page.close();
  }
}
const { page } = await open(chrome, server.url, { width: 960, height: 540 });
await page.goto(server.url);
await until(page, () => globalThis.app?.firstPicture && globalThis.app.ticks > 260);
await page.screenshot({ path: join(folder, 'screenshot.png') });
await chrome.close();
server.close();
