// The 3D view of the asset: loads the glb and connects the controls of the page with what is drawn.
import * as THREE from 'three';
import { GLTFLoader } from './GLTFLoader.js';
import { OrbitControls } from './OrbitControls.js';
import { Channels } from './channels.js';
import { Lights } from './lights.js';
import { cameraAt, frameOf, frusta, lookThrough } from './cameras.js';
import { landmarkDots, Turning } from './marks.js';
import { geometriesOf, reliefFree, scanMaterial } from './meshes.js';

const $ = (id) => document.getElementById(`viewer-${id}`);
const STEP = Math.PI / 24; // radians per press of an arrow key

class Viewer {
  constructor(data, gltf) {
    this.data = data;
    this.canvas = $("canvas");
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.scene.add(gltf.scene);
    this.asset = gltf.scene;
    this.meshes = new Map([["asset", gltf.scene]]);
    this.channels = new Channels(data, gltf.scene);
    this.lights = new Lights(this.renderer, this.scene, data.lights);
    const box = new THREE.Box3().setFromObject(gltf.scene);
    this.centre = box.getCenter(new THREE.Vector3());
    this.radius = box.getSize(new THREE.Vector3()).length() / 2;
    this.view = new THREE.PerspectiveCamera(28, 1, this.radius / 50, this.radius * 60);
    this.controls = new OrbitControls(this.view, this.canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.frusta = frusta(data.cameras, 0.25 * this.radius);
    this.scene.add(this.frusta);
    this.landmarks = landmarkDots(data.landmarks, this.radius);
    this.scene.add(this.landmarks);
    this.turning = new Turning((angle) => this.turn(angle / STEP, 0));
    this.photo = null;
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    this.view.aspect = clientWidth / clientHeight;
    this.home();
  }

  // Shows one of the page's meshes, or "asset", the glb. text: of its data.
  async show(name, text) {
    if (!this.meshes.has(name)) {
      const kind = this.data.meshes.find((m) => m.name === name), group = new THREE.Group();
      const geometries = await geometriesOf(text, kind);
      for (const [i, geometry] of geometries.entries()) {
        const { tile } = kind.parts[i], look = this.channels.lookOf(tile);
        const material = kind.scan ? await scanMaterial(this.data.scan, tile) : kind.smooth ? reliefFree(look) : look.clone();
        const mesh = new THREE.Mesh(geometry, material);
        this.channels.add(mesh, tile, kind.scan ? this.data.scan.maps : this.data.maps);
        group.add(mesh);
      }
      this.scene.add(group);
      this.meshes.set(name, group);
    }
    for (const [other, group] of this.meshes) group.visible = other === name;
  }

  home() {
    this.photo = null;
    this.controls.enabled = true;
    this.view.up.set(0, 1, 0);
    this.view.scale.set(1, 1, 1);
    this.controls.target.copy(this.centre);
    const away = this.radius / Math.sin(this.view.fov / 2 * Math.PI / 180) * (this.frusta.visible ? 4 : 0.8) / Math.min(1, this.view.aspect);
    this.view.position.copy(this.centre).add(new THREE.Vector3(0.35, 0.1, 1).normalize().multiplyScalar(away));
    this.view.updateProjectionMatrix();
    this.controls.update();
    this.draw();
  }

  // Turns the view around the asset, as the arrow keys do.
  turn(right, up) {
    const away = this.view.position.clone().sub(this.controls.target);
    const at = new THREE.Spherical().setFromVector3(away);
    at.theta -= right * STEP;
    at.phi = Math.min(Math.max(at.phi - up * STEP, 0.05), Math.PI - 0.05);
    this.view.position.setFromSpherical(at).add(this.controls.target);
    this.controls.update();
    this.draw();
  }

  zoom(factor) {
    this.view.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
    this.draw();
  }

  through(camera) {
    this.turning.set(false);
    $("turning").checked = false;
    this.photo = camera;
    this.controls.enabled = false;
    this.draw();
  }

  resize() {
    const { clientWidth: w, clientHeight: h } = this.canvas.parentElement;
    this.renderer.setSize(w, h, false);
    this.view.aspect = w / h;
    if (!this.photo) this.view.updateProjectionMatrix();
    this.draw();
  }

  // Draws once before the next repaint: nothing runs while nothing changes.
  draw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      const { clientWidth: w, clientHeight: h } = this.canvas.parentElement;
      if (this.photo) lookThrough(this.view, this.photo, w, h);
      this.renderer.render(this.scene, this.view);
      this.canvas.dataset.frames = Number(this.canvas.dataset.frames || 0) + 1;
    });
  }
}

function options(select, entries) {
  for (const [value, text] of entries) select.add(new Option(text, value));
}

function connectChannels(viewer) {
  const { channels } = viewer.data;
  options($("channel"), channels.map((c) => [c.name, c.label]));
  const show = async () => {
    const channel = channels.find((c) => c.name === $("channel").value);
    await viewer.channels.show(channel);
    const legend = $("legend");
    legend.hidden = !("low" in channel) && !channel.names;
    legend.querySelector(".bar").hidden = !("low" in channel);
    legend.querySelector(".ends").textContent = "low" in channel ? `${channel.low} to ${channel.high} ${channel.unit}` : "";
    legend.querySelector(".codes").replaceChildren(...(channel.names || []).map((name, i) => {
      const item = document.createElement("span");
      item.innerHTML = "<i></i>";
      item.firstChild.style.background = channel.legend[i];
      item.append(name);
      return item;
    }));
    viewer.draw();
    $("channel").dataset.shown = channel.name;
  };
  $("channel").addEventListener("change", show);
  return show;
}

// Which mesh is shown: the glb, or another of the page. refresh: gives it the present channel and light.
function connectMeshes(viewer, refresh) {
  const select = $("mesh");
  options(select, [["asset", viewer.data.asset], ...viewer.data.meshes.map((m) => [m.name, m.label])]);
  select.parentElement.hidden = viewer.data.meshes.length === 0;
  select.addEventListener("change", async () => {
    const name = select.value;
    $("mesh-words").textContent = "";
    try {
      await viewer.show(name, name === "asset" ? "" : $(`mesh-${name}`).textContent);
      await refresh();
      $("expressions").hidden = name !== "asset" || $("expressions").querySelector("input") === null;
      select.dataset.shown = name;
    } catch (error) {
      $("mesh-words").textContent = `can't be shown: ${error.message || error}`;
    }
    viewer.draw();
  });
}

function connectLight(viewer) {
  options($("light"), viewer.data.lights.map((x) => [x.name, x.label]));
  const set = async () => {
    const name = $("light").value;
    viewer.lights.use(name, Number($("turn").value), $("background").checked);
    viewer.renderer.toneMapping = $("tone").checked ? THREE.NeutralToneMapping : THREE.LinearToneMapping;
    viewer.renderer.toneMappingExposure = 2 ** Number($("exposure").value);
    $("exposure-value").textContent = `${Number($("exposure").value).toFixed(1)} EV`;
    $("turn-value").textContent = `${$("turn").value}°`;
    await viewer.channels.arriving(name === "captured");
    viewer.draw();
  };
  for (const id of ["light", "turn", "exposure", "background", "tone"]) $(id).addEventListener("input", set);
  return set;
}

function connectCameras(viewer) {
  const { cameras } = viewer.data, photo = $("photo"), split = $("split");
  options($("camera"), [["", "free view"], ...cameras.map((c, i) => [i, `${c.name} (${c.kind}${c.photo ? ", photo" : ""})`])]);
  const cut = () => {
    const share = Number(split.value);
    photo.style.clipPath = `inset(0 ${100 - share}% 0 0)`;
    $("edge").style.left = `${photo.offsetLeft + photo.offsetWidth * share / 100}px`;
  };
  const place = () => {
    if (!viewer.photo) return;
    const { clientWidth, clientHeight } = viewer.canvas.parentElement;
    const frame = frameOf(viewer.photo, clientWidth, clientHeight);
    for (const [k, v] of Object.entries(frame)) photo.style[k] = `${v}px`;
    Object.assign($("edge").style, { top: `${frame.top}px`, height: `${frame.height}px` });
    cut();
  };
  const choose = () => {
    const camera = cameras[$("camera").value];
    const shown = Boolean(camera && camera.photo);
    photo.hidden = $("edge").hidden = $("split-row").hidden = $("compare-row").hidden = !shown;
    if (!camera) return viewer.home();
    if (shown) photo.src = camera.photo;
    viewer.through(camera);
    return place();
  };
  split.addEventListener("input", cut);
  $("compare").addEventListener("change", () => { photo.classList.toggle("difference", $("compare").value === "difference"); });
  $("camera").addEventListener("change", choose);
  $("frusta").addEventListener("input", () => {
    viewer.frusta.visible = $("frusta").checked;
    if (!viewer.photo) viewer.home();
  });
  $("home").addEventListener("click", () => { $("camera").value = ""; choose(); });
  let down = null;
  viewer.canvas.addEventListener("pointerdown", (e) => { down = [e.offsetX, e.offsetY]; });
  viewer.canvas.addEventListener("pointerup", (e) => {
    if (!down || !viewer.frusta.visible || viewer.photo || Math.hypot(e.offsetX - down[0], e.offsetY - down[1]) > 5) return;
    const { clientWidth, clientHeight } = viewer.canvas.parentElement;
    const found = cameraAt(cameras, viewer.view, e.offsetX, e.offsetY, clientWidth, clientHeight);
    if (found >= 0) { $("camera").value = found; choose(); }
  });
  new ResizeObserver(() => { viewer.resize(); place(); }).observe(viewer.canvas.parentElement);
  return choose;
}

function connectKeys(viewer, choose) {
  const keys = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  viewer.canvas.addEventListener("keydown", (e) => {
    if (keys[e.key] && !viewer.photo) viewer.turn(...keys[e.key]);
    else if ((e.key === "+" || e.key === "-") && !viewer.photo) viewer.zoom(e.key === "+" ? 0.9 : 1 / 0.9);
    else if (e.key === "Home" || e.key === "Escape") { $("camera").value = ""; choose(); }
    else return;
    e.preventDefault();
  });
}

// A slider for each morph target of the glb, by its name; parts that share a name move together.
function connectExpressions(viewer) {
  const moved = new Map();
  viewer.scene.traverse((o) => {
    for (const [name, i] of Object.entries(o.morphTargetDictionary || {})) {
      if (!moved.has(name)) moved.set(name, []);
      moved.get(name).push([o, i]);
    }
  });
  $("expressions").hidden = moved.size === 0;
  for (const [name, parts] of moved) {
    const label = document.createElement("label"), slider = document.createElement("input");
    Object.assign(slider, { type: "range", min: 0, max: 1, step: 0.01, value: 0 });
    slider.addEventListener("input", () => {
      for (const [mesh, i] of parts) mesh.morphTargetInfluences[i] = Number(slider.value);
      viewer.draw();
    });
    label.append(name, slider);
    $("expressions").append(label);
  }
}

// Landmarks, if there are any, and the turn around the asset.
function connectMarks(viewer, choose) {
  $("landmarks").parentElement.hidden = viewer.data.landmarks.length === 0;
  $("landmarks").addEventListener("input", () => {
    viewer.landmarks.visible = $("landmarks").checked;
    viewer.draw();
  });
  $("turning").addEventListener("input", () => {
    const on = $("turning").checked;
    if (on && viewer.photo) { $("camera").value = ""; choose(); }
    viewer.turning.set(on);
    $("turning").checked = on;
  });
}

export async function start(data, glb) {
  const gltf = await new GLTFLoader().parseAsync(glb, "");
  const viewer = new Viewer(data, gltf);
  const channel = connectChannels(viewer), light = connectLight(viewer);
  await channel();
  await light();
  connectMeshes(viewer, async () => { await channel(); await light(); });
  const choose = connectCameras(viewer);
  connectKeys(viewer, choose);
  connectMarks(viewer, choose);
  connectExpressions(viewer);
  viewer.resize();
  $("status").hidden = true;
}
