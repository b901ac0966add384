// The picture: one character's shapes, the three devices' frames, floor, light and shadow.
//
// MuJoCo's axes are x forward, y left, z up; three's and WebXR's are x right, y up, -z forward.  Everything of MuJoCo's
// stands in groups whose matrix is TO_THREE, in MuJoCo's own coordinates.

import * as THREE from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { mergeGeometries } from 'three/addons/utils/BufferGeometryUtils.js';
import { SHAPES } from './character.js';

export const TO_THREE = new THREE.Matrix4().set(0, -1, 0, 0, 0, 0, 1, 0, -1, 0, 0, 0, 0, 0, 0, 1);
export const TO_MUJOCO = TO_THREE.clone().invert();
const SKY = 0xdcebf5;
const DEVICE_COLOURS = [0x2b3440, 0x2f7fd6, 0xd6672f]; // headset, left, right

function geometryOf({ type, size: [a, b, c] }) {
  const upright = (g) => g.rotateX(Math.PI / 2); // along y in three, along z in MuJoCo
  if (type === SHAPES.SPHERE) return new THREE.SphereGeometry(a, 18, 12);
  if (type === SHAPES.CAPSULE) return upright(new THREE.CapsuleGeometry(a, 2 * b, 4, 12));
  if (type === SHAPES.ELLIPSOID) return new THREE.SphereGeometry(1, 18, 12).scale(a, b, c);
  if (type === SHAPES.CYLINDER) return upright(new THREE.CylinderGeometry(a, a, 2 * b, 18));
  if (type === SHAPES.BOX) return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
  return null;
}

// One geometry a body, its colours at the vertices: a tenth of the draw calls.  -> body -> geometry
function bodyGeometries(shapes) {
  const parts = new Map();
  for (const shape of shapes) {
    const geometry = geometryOf(shape);
    if (!geometry) continue;
    geometry.deleteAttribute('uv');
    const [w, x, y, z] = shape.quat;
    const place = new THREE.Matrix4().compose(
      new THREE.Vector3(...shape.pos), new THREE.Quaternion(x, y, z, w), new THREE.Vector3(1, 1, 1));
    geometry.applyMatrix4(place);
    const colour = new THREE.Color().setRGB(...shape.rgba.slice(0, 3), THREE.SRGBColorSpace).toArray();
    const colours = Array.from({ length: geometry.attributes.position.count }, () => colour).flat();
    geometry.setAttribute('color', new THREE.Float32BufferAttribute(colours, 3));
    parts.set(shape.body, [...(parts.get(shape.body) || []), geometry]);
  }
  return new Map([...parts].map(([body, list]) => [body, mergeGeometries(list)]));
}

function frameOf(colour, size) { // a device: a small block and its three axes
  const group = new THREE.Group();
  const box = new THREE.BoxGeometry(size, size, size);
  const block = new THREE.Mesh(box, new THREE.MeshLambertMaterial({ color: colour }));
  group.add(block, new THREE.AxesHelper(0.18));
  return group;
}

function checkered(light, dark, times) { // squares of 1 m, so that steps can be seen
  const canvas = Object.assign(document.createElement('canvas'), { width: 128, height: 128 });
  const c = canvas.getContext('2d');
  c.fillStyle = light;
  c.fillRect(0, 0, 128, 128);
  c.fillStyle = dark;
  c.fillRect(0, 0, 64, 64);
  c.fillRect(64, 64, 64, 64);
  const texture = new THREE.CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.repeat.set(times, times);
  texture.anisotropy = 8;
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}

class Body { // one copy of the character, in a group of its own
  constructor(root) {
    this.group = new THREE.Group();
    this.group.matrixAutoUpdate = false;
    this.parts = new Map();
    root.add(this.group);
  }

  build(geometries, material) {
    this.group.clear();
    this.parts.clear();
    for (const [body, geometry] of geometries) {
      const mesh = new THREE.Mesh(geometry, material);
      mesh.castShadow = mesh.receiveShadow = true;
      mesh.frustumCulled = false;
      mesh.userData.body = body;
      this.parts.set(body, mesh);
      this.group.add(mesh);
    }
  }
}

export class View {
  constructor(canvas) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.renderer.xr.enabled = true;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(SKY);
    this.scene.fog = new THREE.Fog(SKY, 8, 22);
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.05, 60);
    this.camera.position.set(-1.6, 1.5, -3.6);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enablePan: false, minDistance: 1.2, maxDistance: 9, maxPolarAngle: 1.62 });
    this.#surroundings();
    this.actor = new Body(this.scene); // on the screen; in a headset the mirror image
    this.second = new Body(this.scene); // in a headset, beside the user
    this.second.group.visible = false;
    this.devices = new THREE.Group();
    this.devices.matrixAutoUpdate = false;
    this.devices.add(...DEVICE_COLOURS.map((c, i) => frameOf(c, i ? 0.05 : 0.09)));
    this.devices.visible = false;
    this.scene.add(this.devices);
    this.rope = new THREE.Line(new THREE.BufferGeometry().setFromPoints([new THREE.Vector3(), new THREE.Vector3()]),
      new THREE.LineBasicMaterial({ color: 0xd0443a }));
    this.rope.frustumCulled = false;
    this.rope.visible = false;
    this.scene.add(this.rope);
    this.material = new THREE.MeshLambertMaterial({ vertexColors: true });
    this.states = [];
    this.height = 1.6;
    this.screenPlaces();
  }

  #surroundings() {
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0xb9c4c9, 1.9));
    this.sun = new THREE.DirectionalLight(0xfff4e0, 2.1);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    Object.assign(this.sun.shadow.camera, { left: -3, right: 3, top: 3, bottom: -3, near: 0.5, far: 12 });
    this.sun.shadow.bias = -0.0005;
    this.sun.shadow.normalBias = 0.02;
    this.scene.add(this.sun, this.sun.target);
    this.floor = new THREE.Group();
    const ground = new THREE.Mesh(new THREE.PlaneGeometry(60, 60).rotateX(-Math.PI / 2),
      new THREE.MeshLambertMaterial({ map: checkered('#b9c9d4', '#aabcc9', 30) }));
    ground.receiveShadow = true;
    this.floor.add(ground);
    this.scene.add(this.floor);
  }

  // A new character: shapes as character.visualShapes returns them.
  build(shapes) {
    const geometries = bodyGeometries(shapes);
    for (const body of [this.actor, this.second]) body.build(geometries, this.material);
    this.states = [];
    this.placed = false;
    this.fresh = true;
  }

  // A state of the worker; the picture goes from the last one to this one until the next one comes.
  take(state, now) {
    this.states = [this.states.at(-1), { ...state, at: now }].filter(Boolean);
    if (state.end && this.states.length > 1) this.states.shift(); // stood up anew: a jump, not a movement
  }

  pose(now) {
    const next = this.states.at(-1);
    if (!next) return;
    const last = this.states[0];
    const span = Math.min(Math.max(next.at - last.at, 1), 100);
    const share = last === next ? 1 : Math.min((now - next.at) / span, 1);
    const [q, q2] = [new THREE.Quaternion(), new THREE.Quaternion()];
    const read = (array, b, out) => out.set(array[4 * b + 1], array[4 * b + 2], array[4 * b + 3], array[4 * b]);
    for (const [b, mesh] of this.actor.parts) {
      const mix = (k) => last.xpos[3 * b + k] + share * (next.xpos[3 * b + k] - last.xpos[3 * b + k]);
      mesh.position.set(mix(0), mix(1), mix(2));
      mesh.quaternion.copy(read(last.xquat, b, q).slerp(read(next.xquat, b, q2), share));
      const twin = this.second.parts.get(b);
      twin.position.copy(mesh.position);
      twin.quaternion.copy(mesh.quaternion);
    }
    this.devices.visible = Boolean(next.sensors);
    if (next.sensors) {
      this.devices.children.forEach((frame, i) => {
        const [w, x, y, z] = next.sensors.quat[i];
        frame.position.set(...next.sensors.pos[i]);
        frame.quaternion.set(x, y, z, w);
        frame.children[0].material.opacity = next.lost[i] ? 0.35 : 1;
        frame.children[0].material.transparent = true;
      });
    }
  }

  rootOf(body) { // where a body of the actor is, in three's world
    return this.actor.parts.get(body)?.getWorldPosition(new THREE.Vector3()) ?? new THREE.Vector3();
  }

  // The camera keeps its distance and direction while the character walks.
  follow(root, now) {
    const at = this.rootOf(root);
    const wanted = new THREE.Vector3(at.x, this.height * 0.5, at.z);
    const gap = wanted.sub(this.controls.target);
    const share = this.placed && gap.length() < 3 ? 1 - Math.exp(-(now - (this.followed ?? now)) / 250) : 1;
    this.followed = now;
    this.placed = true;
    if (this.fresh) this.#approach();
    gap.multiplyScalar(share);
    this.controls.target.add(gap);
    this.camera.position.add(gap);
    this.controls.update();
    this.#light(at);
  }

  #approach() { // a new character: as far away as its size asks for
    this.fresh = false;
    const { target } = this.controls;
    const away = this.camera.position.clone().sub(target).setLength(2 + 1.2 * this.height);
    this.camera.position.copy(target).add(away);
  }

  #light(at) {
    this.sun.position.set(at.x - 2, 5.5, at.z - 1.5);
    this.sun.target.position.set(at.x, 0, at.z);
    const even = (v) => 2 * Math.round(v / 2);
    this.floor.position.set(even(at.x), this.floor.position.y, even(at.z)); // its squares seem to stand still
  }

  // ---- places

  screenPlaces() {
    this.actor.group.matrix.copy(TO_THREE);
    this.devices.matrix.copy(TO_THREE);
    this.second.group.visible = false;
    this.floor.position.y = 0;
    this.placed = false;
  }

  // In a headset: `calibration` says where the user stood and looked.  x -> 2 d - x is a mirror at d metres.
  headsetPlaces(calibration, apart) {
    const { origin: [x, y, z], yaw } = calibration;
    const base = TO_THREE.clone().multiply(new THREE.Matrix4().makeTranslation(x, y, z))
      .multiply(new THREE.Matrix4().makeRotationZ(yaw));
    const flip = new THREE.Matrix4().makeScale(-1, 1, 1);
    const mirror = new THREE.Matrix4().makeTranslation(2 * apart, 0, 0).multiply(flip);
    this.actor.group.matrix.copy(base).multiply(mirror);
    this.devices.matrix.copy(this.actor.group.matrix);
    this.second.group.matrix.copy(base).multiply(new THREE.Matrix4().makeTranslation(0, 1.3, 0));
    this.second.group.visible = true;
    this.floor.position.y = z;
  }

  lightActor(root) {
    this.#light(this.rootOf(root));
  }

  // ---- pointing

  // -> { body, at: in the body's axes, point: in three's world } or null
  hit(x, y) {
    const { width, height, left, top } = this.renderer.domElement.getBoundingClientRect();
    this.ray = this.ray || new THREE.Raycaster();
    const pointer = new THREE.Vector2((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height);
    this.ray.setFromCamera(pointer, this.camera);
    const [found] = this.ray.intersectObjects([...this.actor.parts.values()], false);
    if (!found) return null;
    return { body: found.object.userData.body, at: found.object.worldToLocal(found.point.clone()).toArray(),
      point: found.point.clone() };
  }

  // Where the pointer is in the plane through `point` that faces the camera, in MuJoCo's coordinates.
  inPlane(x, y, point) {
    this.hit(x, y);
    const normal = this.camera.getWorldDirection(new THREE.Vector3());
    const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(normal, point);
    const at = this.ray.ray.intersectPlane(plane, new THREE.Vector3());
    return at && at.applyMatrix4(TO_MUJOCO).toArray();
  }

  showRope(pull) { // from the body's point to the pointer
    this.rope.visible = Boolean(pull);
    if (!pull) return;
    const start = this.actor.parts.get(pull.body).localToWorld(new THREE.Vector3(...pull.at));
    const end = new THREE.Vector3(...pull.target).applyMatrix4(TO_THREE);
    this.rope.geometry.setFromPoints([start, end]);
  }

  // free : { left, right, top, bottom } of the window that nothing lies over; the character stands in its middle.
  resize({ left, right, top, bottom }) {
    if (this.renderer.xr.isPresenting) return;
    const [w, h] = [window.innerWidth, window.innerHeight];
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(w, h, false);
    const share = Math.max(bottom - top, h / 5) / h;
    this.camera.aspect = w / h;
    this.camera.fov = (360 / Math.PI) * Math.atan(Math.tan(Math.PI / 9) / share); // 40 degrees of what is free
    this.camera.setViewOffset(w, h, (w - left - right) / 2, (h - top - bottom) / 2, w, h);
  }
}
