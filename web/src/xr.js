// WebXR: a headset and two controllers as rows that the stream reads.

import * as THREE from 'three';

const NOTHING = { pos: [NaN, NaN, NaN], quat: [NaN, NaN, NaN, NaN] };

export const supported = async () => {
  try {
    return Boolean(navigator.xr && await navigator.xr.isSessionSupported('immersive-vr'));
  } catch {
    return false;
  }
};

// One frame -> a sample in WebXR's axes, quaternions x, y, z, w; NaN where a device is not tracked.
export function sampleOf(frame, time, space, sources) {
  const read = (pose) => {
    if (!pose) return NOTHING;
    const { position: p, orientation: q } = pose.transform;
    return { pos: [p.x, p.y, p.z], quat: [q.x, q.y, q.z, q.w] };
  };
  const held = (side) => {
    const source = [...sources].find((s) => s.handedness === side);
    const where = source && (source.gripSpace || source.targetRaySpace);
    return read(where && frame.getPose(where, space));
  };
  const devices = [read(frame.getViewerPose(space)), held('left'), held('right')];
  return { t: time / 1000, pos: devices.map((d) => d.pos), quat: devices.map((d) => d.quat) };
}

export class Panel { // a few lines of text that stand before the user
  constructor() {
    this.canvas = Object.assign(document.createElement('canvas'), { width: 1024, height: 256 });
    this.texture = new THREE.CanvasTexture(this.canvas);
    this.mesh = new THREE.Mesh(new THREE.PlaneGeometry(1.2, 0.3),
      new THREE.MeshBasicMaterial({ map: this.texture, transparent: true, fog: false }));
    this.mesh.visible = false;
    this.text = '';
  }

  write(lines) {
    if (lines.join('\n') === this.text) return;
    this.text = lines.join('\n');
    const c = this.canvas.getContext('2d');
    c.clearRect(0, 0, 1024, 256);
    c.fillStyle = '#ffffffdd';
    c.fillRect(0, 0, 1024, 256);
    c.fillStyle = '#1d2733';
    c.textAlign = 'center';
    lines.forEach((line, i) => {
      c.font = i ? '40px sans-serif' : 'bold 56px sans-serif';
      c.fillText(line, 512, 90 + 62 * i, 980);
    });
    this.texture.needsUpdate = true;
  }

  // Before the headset, at its height, where the user looks along the floor.
  before(camera, metres, up = 0) {
    const ahead = camera.getWorldDirection(new THREE.Vector3()).setY(0);
    if (ahead.lengthSq() < 1e-6) ahead.set(0, 0, -1);
    const head = camera.getWorldPosition(new THREE.Vector3());
    this.mesh.position.copy(head).addScaledVector(ahead.normalize(), metres);
    this.mesh.position.y += up;
    this.mesh.lookAt(head.x, this.mesh.position.y, head.z);
  }
}
