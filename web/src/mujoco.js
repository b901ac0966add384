// MuJoCo's WebAssembly, its file beside the script that asks for it.

import load from '@mujoco/mujoco';

export const loadMujoco = () => load({ locateFile: (file) => new URL(file, import.meta.url).href });
