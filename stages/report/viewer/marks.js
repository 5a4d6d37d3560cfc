// What moves or lies on top of the asset: the face's landmarks, and the turn around it.
import * as THREE from 'three';

const TURN_SECONDS = 8; // of a whole turn

// The landmarks [[x, y, z], ...] as dots that the asset does not hide. radius: of the asset, metres.
export function landmarkDots(landmarks, radius) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(landmarks.flat(), 3));
  const material = new THREE.PointsMaterial({ color: 0xe69f00, size: radius / 60, depthTest: false });
  const out = new THREE.Points(geometry, material);
  out.renderOrder = 1;
  out.visible = false;
  return out;
}

// Calls turn(radians) before each repaint while `on` is true.
export class Turning {
  constructor(turn) {
    this.turn = turn;
    this.on = false;
  }

  set(on) {
    if (on && !this.on) requestAnimationFrame((now) => this.step(now, now));
    this.on = on;
  }

  step(before, now) {
    if (!this.on) return;
    this.turn(2 * Math.PI * Math.min(now - before, 200) / 1000 / TURN_SECONDS);
    requestAnimationFrame((next) => this.step(now, next));
  }
}
