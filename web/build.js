// npm run build: the data by `python -m web export`, the scripts by esbuild, into dist/, which any static host takes.

import { build } from 'esbuild';
import { execFileSync } from 'node:child_process';
import { cpSync, mkdirSync, readFileSync, readdirSync, rmSync, statSync, writeFileSync } from 'node:fs';
import { dirname, join } from 'node:path';
import { fileURLToPath } from 'node:url';
import { gzipSync } from 'node:zlib';

const here = dirname(fileURLToPath(import.meta.url));
const from = (...parts) => join(here, ...parts);
const python = process.env.PYTHON || 'python3';

// MuJoCo's glue makes two kinds of functions out of strings, which a strict Content-Security-Policy forbids.  Closures
// do the same.  If another version of the package reads otherwise, the build fails here, not in the visitor's browser.
const CLOSURES = [[
  `      let [args, invokerFnBody] = createJsInvoker(argTypes, isClassMethodFunc, returns, isAsync);
      var invokerFn = new Function(...args, invokerFnBody)(...closureArgs);`,
  `      var first = isClassMethodFunc ? 1 : 2;
      var invokerFn = function (...values) {
        checkArgCount(values.length, minArgs, expectedArgCount, humanName, throwBindingError);
        var stack = needsDestructorStack ? [] : null;
        var wired = isClassMethodFunc ? [argTypes[1].toWireType(stack, this)] : [];
        for (var i = 0; i < expectedArgCount; ++i) wired.push(argTypes[i + 2].toWireType(stack, values[i]));
        var rv = cppInvokerFunc(cppTargetFunc, ...wired);
        if (stack) runDestructors(stack);
        else for (var i = first; i < argTypes.length; ++i) {
          if (argTypes[i].destructorFunction !== null) argTypes[i].destructorFunction(wired[i - first]);
        }
        if (returns) return argTypes[0].fromWireType(rv);
      };`,
], [
  '      var invokerFunction = new Function(...params, functionBody)(...args);',
  `      var invokerFunction = function (obj, func, destructorsRef, values) {
        var read = [], at = 0;
        for (var type of types) {
          read.push(type.readValueFromPointer(values + at));
          at += type.argPackAdvance;
        }
        var rv = kind === 1 ? new func(...read) : func.call(obj, ...read);
        if (!retType.isVoid) return emval_returnValue(retType, destructorsRef, rv);
      };`,
]];

export const noEval = {
  name: 'closures instead of new Function',
  setup({ onLoad }) {
    onLoad({ filter: /@mujoco[\\/]mujoco[\\/]mujoco\.js$/ }, ({ path }) => {
      let contents = readFileSync(path, 'utf8');
      for (const [old, better] of CLOSURES) {
        if (contents.split(old).length !== 2) throw new Error(`${path}: reads otherwise; adapt CLOSURES in build.js`);
        contents = contents.replace(old, () => better);
      }
      if (contents.includes('new Function')) throw new Error(`${path}: has another "new Function"`);
      return { contents, loader: 'js' };
    });
  },
};

export const bundle = (entryPoints, outdir) => build({
  entryPoints, outdir, bundle: true, format: 'esm', platform: 'browser', target: 'es2022', minify: true,
  external: ['module'], // MuJoCo's glue imports it under Node alone
  legalComments: 'none', plugins: [noEval], logLevel: 'warning',
});

function licences() {
  const three = readFileSync(from('node_modules/three/LICENSE'), 'utf8');
  const ours = readFileSync(from('../LICENSE'), 'utf8');
  return `This page\n\n${ours}\n\nthree.js\n\n${three}\n\nMuJoCo (mujoco.wasm and its glue in worker.js)\n\n`
    + 'Copyright DeepMind Technologies Limited. Apache License 2.0: https://www.apache.org/licenses/LICENSE-2.0\n'
    + 'Changed: two functions of the glue that were made from text are written out (build.js).\n';
}

async function main() {
  rmSync(from('dist'), { recursive: true, force: true });
  mkdirSync(from('dist/data'), { recursive: true });
  try {
    execFileSync(python, ['-m', 'web', 'export'], { cwd: from('..'), stdio: ['ignore', 'inherit', 'inherit'] });
  } catch {
    console.error(`build: \`${python} -m web export\` failed; PYTHON=… names the Python that has mujoco`);
    process.exit(1);
  }
  await bundle([from('src/main.js'), from('src/worker.js')], from('dist'));
  cpSync(from('page'), from('dist'), { recursive: true });
  cpSync(from('node_modules/@mujoco/mujoco/mujoco.wasm'), from('dist/mujoco.wasm'));
  writeFileSync(from('dist/LICENCES.txt'), licences());
  let [raw, packed] = [0, 0];
  for (const entry of readdirSync(from('dist'), { recursive: true })) {
    const path = from('dist', entry);
    if (!statSync(path).isFile()) continue;
    const content = readFileSync(path);
    const zipped = gzipSync(content, { level: 9 }).length;
    const other = /^data[\\/](oppy|dino)\./.test(entry); // loaded when they are picked
    if (!other) [raw, packed] = [raw + content.length, packed + zipped];
    console.log(`${entry.padEnd(18)} ${(content.length / 1e6).toFixed(2)} MB, gzip ${(zipped / 1e6).toFixed(3)} MB`);
  }
  const first = `first visit: ${(raw / 1e6).toFixed(2)} MB, gzip ${(packed / 1e6).toFixed(2)} MB`;
  console.log(`${first} (the other characters when they are picked)`);
}

if (process.argv[1] === fileURLToPath(import.meta.url)) await main();
