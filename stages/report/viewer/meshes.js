// Meshes beside the glb, unpacked when they are first chosen (the inverse of viewer_pack.py).
import * as THREE from 'three';
import { bytesOf, textureOf } from './data.js';

const NORMAL_STEPS = 511, UV_STEPS = (1 << 15) - 1;

// Rows (count x columns) of integers of `size` bytes: planes of bytes of the differences from row to row.
function rows(bytes, at, count, columns, size, Kind) {
  const out = new Kind(count * columns);
  for (let c = 0; c < columns; c++) {
    let value = 0;
    for (let i = 0; i < count; i++) {
      let step = 0;
      for (let b = 0; b < size; b++) step |= bytes[at + (c * size + b) * count + i] << (8 * b);
      value = (value + step) | 0;
      out[i * columns + c] = value;
    }
  }
  return out;
}

// Geometries of the mesh's pieces. text: base64 of gzip; low, step: of the lattice of positions.
export async function geometriesOf(text, { low, step, parts }) {
  const packed = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = new Uint8Array(await new Response(packed).arrayBuffer());
  let at = 0;
  const take = (count, columns, size, Kind) => {
    const found = rows(bytes, at, count, columns, size, Kind);
    at += count * columns * size;
    return found;
  };
  return parts.map(({ vertices, faces }) => {
    const positions = Float32Array.from(take(vertices, 3, 2, Uint16Array), (v, i) => low[i % 3] + step * v);
    const normals = Float32Array.from(take(vertices, 3, 2, Int16Array), (v) => v / NORMAL_STEPS);
    const uvs = Float32Array.from(take(vertices, 2, 2, Uint16Array), (v) => v / UV_STEPS);
    const index = take(3 * faces, 1, 4, Uint32Array);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    geometry.setAttribute("normal", new THREE.BufferAttribute(normals, 3));
    geometry.setAttribute("uv", new THREE.BufferAttribute(uvs, 2));
    geometry.setIndex(new THREE.BufferAttribute(index, 1));
    return geometry;
  });
}

// The asset's material without its normal map: for a mesh that has the relief itself.
export function reliefFree(material) {
  const out = material.clone();
  out.normalMap = null;
  return out;
}

// The material of a tile of the scan from the page's pictures, as the glb would have it. f0: of the largest value.
export async function scanMaterial({ albedo, roughness, normal, specular, f0 }, tile) {
  const [map, rough, relief, reflectance] = await Promise.all([albedo, roughness, normal, specular]
    .map((uris) => (uris ? textureOf(uris[tile]) : null)));
  map.colorSpace = THREE.SRGBColorSpace;
  if (reflectance) reflectance.colorSpace = THREE.SRGBColorSpace;
  const out = new THREE.MeshPhysicalMaterial({ map, metalness: 0, roughness: rough ? 1 : 0.5, roughnessMap: rough,
    normalMap: relief, specularColorMap: reflectance });
  out.normalScale.y = -1; // v runs downwards, and the tangents are those of the coordinates
  if (reflectance) out.specularColor.setScalar(f0 / 0.04);
  return out;
}
