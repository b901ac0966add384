// What the tests share: Python, the server, the browser.

import { execFileSync, spawn } from 'node:child_process';
import { cpSync, existsSync, mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join } from 'node:path';
import { fileURLToPath } from 'node:url';
import puppeteer from 'puppeteer-core';
import { bundle } from '../build.js';

export const web = dirname(dirname(fileURLToPath(import.meta.url)));
export const root = dirname(web);
export const python = process.env.PYTHON || 'python3';
export const CHARACTERS = ['jesse', 'oppy', 'dino'];

export function expected(...args) {
  const out = execFileSync(python, [join(web, 'test/expected.py'), ...args], { cwd: root, maxBuffer: 1e9 });
  return JSON.parse(out);
}

// The built page, with the parity script beside it, behind `python -m web serve`.
export async function serve() {
  if (!existsSync(join(web, 'dist/index.html'))) throw new Error('nothing is built: npm run build');
  const folder = mkdtempSync(join(tmpdir(), 'page-'));
  cpSync(join(web, 'dist'), folder, { recursive: true });
  await bundle([join(web, 'test/parity.js')], folder);
  const empty = '<!doctype html><link rel="icon" href="data:,"><script type="module" src="parity.js"></script>';
  writeFileSync(join(folder, 'parity.html'), empty);
  const server = spawn(python, ['-m', 'web', 'serve', '--port', '0', '--folder', folder], { cwd: root });
  const url = await new Promise((resolve, reject) => {
    let said = '';
    server.stdout.on('data', (data) => {
      said += data;
      if (said.includes('\n')) resolve(said.match(/http\S+/)[0]);
    });
    server.stderr.on('data', (data) => reject(new Error(String(data))));
  });
  return { url, close: () => { server.kill(); rmSync(folder, { recursive: true }); } };
}

export const browser = () => puppeteer.launch({
  executablePath: process.env.CHROMIUM || '/usr/bin/chromium',
  args: ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--disable-dev-shm-usage',
    '--disable-background-timer-throttling'],
  protocolTimeout: 300_000,
});

// A page, and what it must not have: console errors, requests to anywhere else.
export async function open(chrome, url, { width = 480, height = 360, before } = {}) {
  const page = await chrome.newPage();
  const faults = [];
  page.on('console', (m) => { if (m.type() === 'error') faults.push(`console: ${m.text()}`); });
  page.on('pageerror', (error) => faults.push(`page: ${error.message}`));
  page.on('requestfailed', (r) => faults.push(`failed: ${r.url()} ${r.failure()?.errorText}`));
  page.on('request', (r) => {
    if (!r.url().startsWith(url) && !/^(data|blob):/.test(r.url())) faults.push(`foreign: ${r.url()}`);
  });
  await page.setViewport({ width, height });
  if (before) await page.evaluateOnNewDocument(before);
  return { page, faults };
}

export const sleep = (ms) => new Promise((resolve) => { setTimeout(resolve, ms); });

export async function until(page, test, ms = 60_000, ...args) {
  await page.waitForFunction(test, { timeout: ms, polling: 50 }, ...args);
}

export const percentile = (values, share) => [...values].sort((a, b) => a - b)[Math.floor(share * (values.length - 1))];
