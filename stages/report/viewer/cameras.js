// The photos' cameras: drawn as frusta, and the view through one of them.
import * as THREE from 'three';

const REACH_PX = 24; // a click this near to a camera's centre chooses it
const COLOURS = { "fitted": 0x009e73, "held out": 0x56b4e9, "mask dropped": 0xe69f00 };

// Pose of a camera with OpenCV's axes (x right, y down, z forward), as rows, for three.js (y up, -z forward).
function poseOf(camera) {
  return new THREE.Matrix4().set(...camera.world_from_cam.flat())
    .multiply(new THREE.Matrix4().makeScale(1, -1, -1));
}

// Lines of all cameras. length: metres from a centre to its frame.
export function frusta(cameras, length) {
  const points = [], colours = [];
  for (const camera of cameras) {
    const pose = poseOf(camera), { fx, fy, cx, cy, width, height } = camera;
    const flat = [[0, 0], [width, 0], [width, height], [0, height]]
      .map(([u, v]) => [(u - cx) / fx, -(v - cy) / fy]);
    const size = length * 0.5 / Math.max(...flat.flat().map(Math.abs));
    const corners = flat.map(([x, y]) => new THREE.Vector3(x * size, y * size, -length).applyMatrix4(pose));
    const centre = new THREE.Vector3().setFromMatrixPosition(pose);
    const colour = new THREE.Color(COLOURS[camera.kind]);
    corners.forEach((corner, i) => {
      for (const p of [centre, corner, corner, corners[(i + 1) % 4]]) {
        points.push(...p.toArray());
        colours.push(...colour.toArray());
      }
    });
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
  const out = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ vertexColors: true }));
  out.visible = false;
  return out;
}

// Index of the camera whose centre is drawn next to (x, y), pixels of the canvas; -1 if none is near.
export function cameraAt(cameras, view, x, y, width, height) {
  let best = -1, least = REACH_PX;
  cameras.forEach((camera, i) => {
    const p = new THREE.Vector3().setFromMatrixPosition(poseOf(camera)).project(view);
    const away = Math.hypot((p.x + 1) / 2 * width - x, (1 - p.y) / 2 * height - y);
    if (p.z < 1 && away < least) [best, least] = [i, away];
  });
  return best;
}

// Where the picture of a camera lies in a canvas that shows all of it: {left, top, width, height}, CSS pixels.
export function frameOf(camera, width, height) {
  const scale = Math.min(width / camera.width, height / camera.height);
  const [w, h] = [camera.width * scale, camera.height * scale];
  return { left: (width - w) / 2, top: (height - h) / 2, width: w, height: h };
}

// Sets `view` to the photo's camera: its frustum covers the whole canvas, and the photo exactly its frame.
export function lookThrough(view, camera, width, height) {
  const frame = frameOf(camera, width, height), scale = frame.width / camera.width;
  const { fx, fy, cx, cy } = camera, { near, far } = view;
  const left = -frame.left / scale, top = -frame.top / scale;
  const right = (width - frame.left) / scale, bottom = (height - frame.top) / scale;
  poseOf(camera).decompose(view.position, view.quaternion, view.scale);
  view.updateMatrixWorld(true);
  view.projectionMatrix.makePerspective(near * (left - cx) / fx, near * (right - cx) / fx, near * (cy - top) / fy,
    near * (cy - bottom) / fy, near, far);
  view.projectionMatrixInverse.copy(view.projectionMatrix).invert();
}
