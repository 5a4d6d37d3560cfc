// The lights: lat-long pictures in half floats, filtered by roughness for image-based lighting.
import * as THREE from 'three';
import { bytesOf } from './data.js';

const TURN = Math.PI / 180;
// Pixels along a face of the filtered light. three.js takes 256 at least, whose filter needs most of the time in which a
// page without a GPU loads; our lights have 32 pixels to a face.
const FACE = 128;

class Generator extends THREE.PMREMGenerator {
  _setSize() {
    this._cubeSize = FACE;
  }
}

// One light of the page's data {width, height, rgb: base64 of half floats, row 0 at the bottom} as a texture.
function textureOf(light) {
  const rgb = new Uint16Array(bytesOf(light.rgb).buffer);
  const rgba = new Uint16Array((rgb.length / 3) * 4).fill(THREE.DataUtils.toHalfFloat(1));
  for (let i = 0, j = 0; i < rgb.length; i += 3, j += 4) {
    rgba[j] = rgb[i];
    rgba[j + 1] = rgb[i + 1];
    rgba[j + 2] = rgb[i + 2];
  }
  const out = new THREE.DataTexture(rgba, light.width, light.height, THREE.RGBAFormat, THREE.HalfFloatType);
  out.mapping = THREE.EquirectangularReflectionMapping;
  out.minFilter = out.magFilter = THREE.LinearFilter;
  out.wrapS = THREE.RepeatWrapping;
  out.needsUpdate = true;
  return out;
}

export class Lights {
  constructor(renderer, scene, lights) {
    this.renderer = renderer;
    this.scene = scene;
    this.lights = lights;
    this.filtered = new Map();
    this.generator = new Generator(renderer);
  }

  // Uses the light of this name, turned around the vertical axis.
  use(name, degrees, background) {
    if (!this.filtered.has(name)) {
      const picture = textureOf(this.lights.find((x) => x.name === name));
      this.filtered.set(name, { picture, environment: this.generator.fromEquirectangular(picture).texture });
    }
    const { picture, environment } = this.filtered.get(name);
    this.scene.environment = environment;
    this.scene.environmentRotation.set(0, degrees * TURN, 0);
    this.scene.background = background ? picture : null;
    this.scene.backgroundRotation.copy(this.scene.environmentRotation);
    this.scene.backgroundBlurriness = 0.15;
  }
}
