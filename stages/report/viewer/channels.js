// The channels: what the surface shows. `look` is the asset's own material; every other channel replaces it by a
// material without light that shows one map, or a property of the mesh, on a fixed scale.
import * as THREE from 'three';
import { scaleTexture, textureOf } from './data.js';

const CHECKS = 32; // squares along a side of the UV checker
const NONE = new THREE.Color(0x808080); // parts that a map does not cover

// GLSL for `map_fragment`: the colour from `sampled` (the texel) and `vMapUv`.
const SHOWN = {
  value: "diffuseColor.rgb = texture2D( scale, vec2( clamp( ( VALUE - low ) / ( high - low ), 0.0, 1.0 ), 0.5 ) ).rgb;",
  code: "diffuseColor.rgb = texture2D( scale, vec2( ( floor( sampled.r * 255.0 + 0.5 ) + 0.5 ) / count, 0.5 ) ).rgb;",
  density: "diffuseColor.rgb = texture2D( scale, vec2( clamp( ( log2( vMmPerTexel ) - log2( low ) ) / " +
    "( log2( high ) - log2( low ) ), 0.0, 1.0 ), 0.5 ) ).rgb;",
  checker: `vec2 cell = floor( vMapUv * ${CHECKS}.0 ); float odd = mod( cell.x + cell.y, 2.0 );
    vec3 hue = vec3( cell / ${CHECKS}.0, 1.0 - cell.x / ${CHECKS}.0 );
    diffuseColor.rgb = mix( vec3( 0.75 ), 0.08 + 0.35 * hue, odd );`,
};

// A material that shows `texture` by one of SHOWN. VALUE is GLSL for the number of a texel.
function unlit(texture, kind, { scale = null, low = 0, high = 1, value = "sampled.r", count = 1, key = "" } = {}) {
  const out = new THREE.MeshBasicMaterial({ map: texture });
  out.customProgramCacheKey = () => `${kind} ${value} ${key}`;
  out.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, {
      scale: { value: scale }, low: { value: low }, high: { value: high }, count: { value: count },
    });
    const declared = "uniform sampler2D scale; uniform float low; uniform float high; uniform float count;\n" +
      (kind === "density" ? "varying float vMmPerTexel;\n" : "");
    shader.fragmentShader = declared + shader.fragmentShader.replace("#include <map_fragment>",
      `vec4 sampled = texture2D( map, vMapUv );\n${SHOWN[kind].replace("VALUE", value)}`);
    if (kind === "density") {
      shader.vertexShader = "attribute float mmPerTexel; varying float vMmPerTexel;\n" +
        shader.vertexShader.replace("#include <begin_vertex>", "#include <begin_vertex>\nvMmPerTexel = mmPerTexel;");
    }
  };
  return out;
}

// Adds the attribute `mmPerTexel`: the edge of a texel of a map of `size` texels on the surface, mean at each vertex.
function addDensity(geometry, size) {
  if (geometry.attributes.mmPerTexel || !geometry.attributes.uv) return;
  const { position, uv } = geometry.attributes;
  const index = geometry.index.array;
  const surface = new Float64Array(position.count);
  const chart = new Float64Array(position.count);
  const [a, b, c] = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3()];
  for (let i = 0; i < index.length; i += 3) {
    const [p, q, r] = [index[i], index[i + 1], index[i + 2]];
    a.fromBufferAttribute(position, p);
    b.fromBufferAttribute(position, q).sub(a);
    c.fromBufferAttribute(position, r).sub(a);
    const area = b.cross(c).length();
    const flat = Math.abs((uv.getX(q) - uv.getX(p)) * (uv.getY(r) - uv.getY(p)) -
      (uv.getX(r) - uv.getX(p)) * (uv.getY(q) - uv.getY(p)));
    for (const v of [p, q, r]) {
      surface[v] += area;
      chart[v] += flat;
    }
  }
  const edge = Float32Array.from(surface, (s, i) => 1000 * Math.sqrt(s / Math.max(chart[i], 1e-30)) / size);
  geometry.setAttribute("mmPerTexel", new THREE.BufferAttribute(edge, 1));
}

// Multiplies the light that arrives by a map: the diffuse part by its colour, the specular part by the share that
// three.js gives for occlusion. The captured light has its own map (irradiance ratio), as the fit has.
function occlude(material, state) {
  material.onBeforeCompile = (shader) => {
    shader.uniforms.arriving = state.arriving;
    shader.uniforms.hasArriving = state.hasArriving;
    shader.uniforms.darkenSpecular = state.darkenSpecular;
    shader.fragmentShader = "uniform sampler2D arriving; uniform float hasArriving; uniform float darkenSpecular;\n" +
      shader.fragmentShader.replace("#include <aomap_fragment>", `
      if ( hasArriving > 0.5 ) {
        vec3 share = texture2D( arriving, vMapUv ).rgb;
        reflectedLight.indirectDiffuse *= share;
        float seen = dot( share, vec3( 0.3333 ) );
        float facing = saturate( dot( geometryNormal, geometryViewDir ) );
        float kept = saturate( pow( facing + seen, exp2( - 16.0 * material.roughness - 1.0 ) ) - 1.0 + seen );
        reflectedLight.indirectSpecular *= mix( 1.0, kept, darkenSpecular );
      }`);
  };
}

export class Channels {
  // data: the page's; root: the loaded asset. `unavailable`: channels without a map, by name.
  constructor(data, root) {
    this.data = data;
    this.parts = [];
    this.made = new Map();
    this.maps = new Map();
    root.traverse((o) => {
      if (!o.isMesh) return;
      const tile = data.materials.indexOf(o.material.name.replace(/_(eyes|hair)$/, "")); // both have the maps of their tile
      this.add(o, tile, data.maps);
    });
  }

  // A mesh with its own material. maps: addresses of its maps by name, one for each tile.
  add(mesh, tile, maps) {
    const state = { arriving: { value: null }, hasArriving: { value: 0 }, darkenSpecular: { value: 0 } };
    if (tile >= 0 && mesh.material.map) occlude(mesh.material, state);
    this.parts.push({ mesh, look: mesh.material, tile, maps, state, lines: null });
  }

  // The material of a tile's skin or cloth.
  lookOf(tile) {
    const own = this.parts.filter((p) => p.tile === tile && p.maps === this.data.maps);
    return (own.find((p) => !p.look.name.endsWith("_eyes")) || own[0] || this.parts[0]).look;
  }

  async load(maps, name, nearest) {
    if (!this.maps.has(maps)) this.maps.set(maps, {});
    const known = this.maps.get(maps);
    known[name] ??= await Promise.all((maps[name] || []).map((uri) => textureOf(uri, { nearest })));
    return known[name];
  }

  // Which map darkens the light that arrives: the captured light's own, or plain occlusion for any other.
  async arriving(captured) {
    for (const { tile, state, maps } of this.parts) {
      const own = captured && maps.irradiance_ratio;
      const textures = await this.load(maps, own ? "irradiance_ratio" : "ambient_occlusion", false);
      state.arriving.value = textures[tile] || null;
      state.hasArriving.value = textures[tile] ? 1 : 0;
      state.darkenSpecular.value = own ? 0 : 1;
    }
  }

  async show(channel) {
    for (const part of this.parts) {
      if (channel.map) await this.load(part.maps, channel.map, channel.kind === "code");
      const key = `${channel.name} ${part.mesh.id}`;
      if (!this.made.has(key)) this.made.set(key, this.material(channel, part));
      part.mesh.material = this.made.get(key);
      this.lines(part, channel.kind === "wireframe");
    }
  }

  material(channel, part) {
    const { look, tile, mesh, maps } = part;
    const texture = channel.map ? this.maps.get(maps)[channel.map][tile] : look[channel.of];
    const range = { low: channel.low, high: channel.high, key: channel.name };
    switch (channel.kind) {
      case "look": return look;
      case "wireframe": return new THREE.MeshBasicMaterial({ color: 0x30343c, polygonOffset: true, polygonOffsetFactor: 1,
        polygonOffsetUnits: 1 });
      case "normal": return new THREE.MeshNormalMaterial({ normalMap: look.normalMap, normalScale: look.normalScale });
      case "colour": return new THREE.MeshBasicMaterial({ map: look.map, color: look.color });
      case "checker": return look.map ? unlit(look.map, "checker") : this.none();
      case "density":
        if (!look.map) return this.none();
        addDensity(mesh.geometry, maps === this.data.maps ? this.data.texels[tile] : Math.max(...this.data.texels));
        return unlit(look.map, "density", { ...range, scale: this.scale(channel) });
      case "code": return texture ? unlit(texture, "code",
        { ...range, scale: this.scale(channel), count: channel.colours.length }) : this.none();
      default: return texture ? unlit(texture, "value", { ...range, scale: this.scale(channel),
        value: this.value(channel, look) }) : this.none();
    }
  }

  // F0 of a texel: 0.04 x factor x texture, whose sRGB encoding the sampler has removed.
  value(channel, look) {
    if (channel.of === "specularColorMap") return `sampled.r * ${(0.04 * look.specularColor.r).toFixed(6)}`;
    return channel.of === "roughnessMap" ? "sampled.g" : "sampled.r";
  }

  scale(channel) {
    const key = channel.colours ? channel.name : "";
    this.scales ??= new Map();
    if (!this.scales.has(key)) this.scales.set(key, scaleTexture(channel.colours || this.data.scale));
    return this.scales.get(key);
  }

  none() {
    return new THREE.MeshBasicMaterial({ color: NONE });
  }

  lines(part, shown) {
    if (shown && !part.lines) {
      const material = new THREE.MeshBasicMaterial({ color: 0x9fd0ff, wireframe: true, transparent: true, opacity: 0.35 });
      part.lines = part.mesh.clone(false);
      part.lines.material = material;
      part.lines.position.set(0, 0, 0);
      part.lines.rotation.set(0, 0, 0);
      part.lines.scale.set(1, 1, 1);
      part.lines.morphTargetInfluences = part.mesh.morphTargetInfluences;
      part.mesh.add(part.lines);
    }
    if (part.lines) part.lines.visible = shown;
  }
}
