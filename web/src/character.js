// A character: MuJoCo's model with the tables that `python -m web export` wrote (twin: character.Character).

import { Policy } from './nn.js';

export const VERSION = 1;
const KINDS = { float32: Float32Array, float64: Float64Array };
const [SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX] = [2, 3, 4, 5, 6];
export const SHAPES = { SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX };

// export.unpacked
export function unpacked(where, buffer) {
  const arrays = {};
  for (const [name, { dtype, shape, offset }] of Object.entries(where)) {
    arrays[name] = new KINDS[dtype](buffer, offset, shape.reduce((a, b) => a * b, 1));
  }
  return arrays;
}

export async function fetchCharacter(folder, file) {
  const get = async (url, how) => {
    const answer = await fetch(url, how);
    if (!answer.ok) throw new Error(`${url.pathname.split('/').pop()}: not found (${answer.status})`);
    return answer;
  };
  const table = await (await get(new URL(file, folder), { cache: 'no-cache' })).json();
  if (table.format !== 'sparse-retarget-web' || table.version !== VERSION) {
    throw new Error(`${file}: version ${table.version} of its format; this page reads ${VERSION}: build it again`);
  }
  const binary = new URL(`${table.binary.file}?v=${table.binary.crc32}`, folder);
  const buffer = await (await get(binary)).arrayBuffer();
  if (buffer.byteLength !== table.binary.bytes) throw new Error(`${table.binary.file}: is cut short; load again`);
  return { table, arrays: unpacked(table.arrays, buffer) };
}

// The simulation leaves out the shapes that are only looked at, as character._Loader.mjspec(visual=False) does.
const simulated = (xml) => xml.replace(/<geom\b[^>]*\bclass="visual"[^>]*\/>/g, '');

export class Simulation {
  // One character in MuJoCo.  Creating another model or data detaches every view: `look` takes them anew.
  constructor(mj, { table, arrays }, substeps = 4, rate = 30) {
    this.mj = mj;
    this.table = table;
    this.policy = new Policy(table.policy, arrays);
    this.model = mj.MjModel.from_xml_string(simulated(table.xml));
    if (this.model.ngeom !== table.geoms) throw new Error(`${this.model.ngeom} shapes, expected ${table.geoms}`);
    this.data = new mj.MjData(this.model);
    for (const name of ['jnt_stiffness', 'dof_damping', 'dof_armature', 'actuator_gear', 'qpos_spring']) {
      this.model[name].set(arrays[name]);
    }
    mj.mj_setConst(this.model, this.data); // contacts and limits are scaled by inertias that the armature changes
    mj.mj_resetData(this.model, this.data);
    this.model.opt.timestep = 1 / rate / substeps;
    this.substeps = substeps;
    this.look();
  }

  look() {
    const d = this.data;
    for (const name of ['qpos', 'qvel', 'ctrl', 'qacc_warmstart', 'xfrc_applied', 'xpos', 'xmat', 'xquat', 'cvel',
      'geom_xpos', 'geom_xmat', 'site_xpos', 'xipos']) this[name] = d[name];
    const m = this.model;
    for (const name of ['geom_type', 'geom_size', 'body_parentid', 'body_ipos', 'body_mass']) this[name] = m[name];
    this.mass = this.body_mass.reduce((a, b) => a + b, 0);
  }

  refresh() { // positions and velocities at the present state: after mj_step they belong to the one before it
    this.mj.mj_fwdPosition(this.model, this.data);
    this.mj.mj_fwdVelocity(this.model, this.data);
  }

  step() { // -> whether MuJoCo kept the state: on NaN it starts again at time 0
    if (!this.qpos.length) this.look();
    const wanted = this.data.time + this.substeps * this.model.opt.timestep;
    for (let i = 0; i < this.substeps; i++) this.mj.mj_step(this.model, this.data);
    this.refresh();
    return Math.abs(this.data.time - wanted) < 1e-6;
  }

  lowest() { // character.geom_lowest over fall_geoms: spheres, capsules and boxes
    let low = Infinity;
    for (const g of this.table.fall_geoms) {
      const type = this.geom_type[g];
      const size = [0, 1, 2].map((i) => this.geom_size[3 * g + i]);
      const half = type === BOX ? size : [0, 0, type === CAPSULE ? size[1] : 0];
      let z = this.geom_xpos[3 * g + 2] - (type === BOX ? 0 : size[0]);
      for (let i = 0; i < 3; i++) z -= Math.abs(this.geom_xmat[9 * g + 6 + i]) * half[i];
      low = Math.min(low, z);
    }
    return low;
  }

  delete() {
    this.data.delete();
    this.model.delete();
  }
}

// The shapes to draw, from the whole MJCF: [{ body, type, size, pos, quat, rgba }].
export function visualShapes(mj, xml) {
  const m = mj.MjModel.from_xml_string(xml);
  const shapes = [];
  const part = (array, i, n) => Array.from(array.subarray(n * i, n * i + n));
  for (let g = 0; g < m.ngeom; g++) {
    if (m.geom_group[g] !== 1) continue;
    const material = m.geom_matid[g];
    shapes.push({
      body: m.geom_bodyid[g],
      type: m.geom_type[g],
      size: part(m.geom_size, g, 3),
      pos: part(m.geom_pos, g, 3),
      quat: part(m.geom_quat, g, 4),
      rgba: material >= 0 ? part(m.mat_rgba, material, 4) : part(m.geom_rgba, g, 4),
    });
  }
  m.delete();
  return shapes;
}
