// What the page carries as text: binary data and pictures.
import * as THREE from 'three';

export function bytesOf(base64) {
  const found = atob(base64), out = new Uint8Array(found.length);
  for (let i = 0; i < out.length; i++) out[i] = found.charCodeAt(i);
  return out;
}

// A map of the asset, in glTF's convention: row 0 is v = 0.
export async function textureOf(uri, { nearest = false } = {}) {
  const image = new Image();
  image.src = uri;
  await image.decode();
  const out = new THREE.Texture(image);
  out.flipY = false;
  out.generateMipmaps = !nearest;
  out.minFilter = nearest ? THREE.NearestFilter : THREE.LinearMipmapLinearFilter;
  out.magFilter = nearest ? THREE.NearestFilter : THREE.LinearFilter;
  out.needsUpdate = true;
  return out;
}

// A colour scale: 256 colours as base64 RGB, or a list of "#rrggbb" for whole numbers.
export function scaleTexture(colours) {
  const list = Array.isArray(colours);
  const rgb = list ? Uint8Array.from(colours.flatMap((c) => [1, 3, 5].map((i) => parseInt(c.slice(i, i + 2), 16))))
    : bytesOf(colours);
  const count = rgb.length / 3;
  const rgba = new Uint8Array(count * 4).fill(255);
  for (let i = 0; i < count; i++) rgba.set(rgb.subarray(3 * i, 3 * i + 3), 4 * i);
  const out = new THREE.DataTexture(rgba, count, 1);
  out.colorSpace = THREE.SRGBColorSpace;
  out.minFilter = out.magFilter = list ? THREE.NearestFilter : THREE.LinearFilter;
  out.needsUpdate = true;
  return out;
}
