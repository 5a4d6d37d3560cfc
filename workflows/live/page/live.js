// The page of a run: asks its server every second what the run tells, and shows it. Text goes in as text, never as HTML.
"use strict";
const BASE = new URL("../", location.href);
const EVERY = 1000;
const AT_WORK = ["running", "pausing", "paused", "stops after the stage"];
const shown = {}; // picture -> its number
let look = null;
let was = false; // whether a run was seen at work

const $ = (id) => document.getElementById(id);
const text = (tag, words, kind = "") => {
  const e = document.createElement(tag);
  e.textContent = words;
  if (kind) e.className = kind;
  return e;
};
const clock = (s) => `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, "0")}`;
const list = (id, items) => {
  $(id).hidden = items.length === 0;
  const key = JSON.stringify(items.map((i) => i.textContent));
  if ($(id).dataset.shown === key) return;
  $(id).dataset.shown = key;
  $(id).querySelector("ul").replaceChildren(...items);
};

function status(state) {
  if (!look.alive && AT_WORK.includes(state.status)) return "The run ended without a word.";
  if (!look.alive && !state.status) return look.whole ? "The run has ended." : "No run is at work here.";
  if (look.alive && !state.status) return "A run is at work here, and tells nothing: it began with --no-live, or by another version.";
  if (state.status === "stopped" || state.status === "failed") return `${state.status === "failed" ? "The run failed" : "The run was stopped"}: ${state.message}`;
  const since = state.status === "paused" || !look.alive ? 0 : Math.max(look.now - state.updated, 0) || 0; // a stage may tell nothing for minutes
  const left = typeof state.remaining === "number" ? `, about ${clock(Math.max(state.remaining - since, 0))} left` : "";
  const words = { running: "At work", pausing: "Pausing at the next checkpoint", paused: "Paused", "stops after the stage": "Stops after this stage" };
  return `${words[state.status] || state.status}: ${state.percent} %, ${clock((state.elapsed || 0) + since)}${left}. ${state.message || ""}`;
}

function showStages(state) {
  const stages = state.stages || [];
  $("stages").hidden = stages.length === 0;
  $("stages").querySelector("tbody").replaceChildren(...stages.map((s) => {
    const row = document.createElement("tr");
    row.className = s.state;
    const share = document.createElement("td");
    share.className = "share";
    const bar = text("div", "", "bar");
    const fill = document.createElement("i");
    fill.style.width = `${100 * (s.share || 0)}%`;
    bar.append(fill);
    share.append(bar);
    const words = s.state === "running" ? `${Math.round(100 * s.share)} %` : s.state === "done" ? `${Number(s.seconds).toFixed(1)} s` : s.state;
    row.append(text("td", s.name.replaceAll("_", " ")), share, text("td", words));
    return row;
  }));
}

async function showPictures(state) {
  for (const [name, picture] of Object.entries(state.pictures || {})) {
    if (shown[name] === picture.number) continue;
    shown[name] = picture.number;
    const section = name === "fit.jpg" ? $("fit") : document.querySelector(`[data-picture="${name}"]`);
    if (!section) continue;
    section.hidden = false;
    section.dataset.number = picture.number;
    section.querySelector("figcaption").textContent = picture.caption;
    const address = new URL(`live/${name}?${picture.number}`, BASE);
    const drawing = section.querySelector(".drawing");
    if (!drawing) { section.querySelector("img").src = address; continue; }
    const svg = new DOMParser().parseFromString(await (await fetch(address)).text(), "image/svg+xml").documentElement;
    if (svg.localName === "svg") drawing.replaceChildren(document.importNode(svg, true));
  }
}

function showCurve(curve) {
  if (!curve || curve.length < 2) return;
  $("fit").hidden = false;
  const steps = curve.map((p) => p[0]), values = curve.map((p) => p[1]);
  const [low, high] = [Math.floor(Math.min(...values)), Math.ceil(Math.max(...values))];
  const last = Math.max(...steps), first = Math.min(...steps);
  const x = (s) => 34 + 358 * (s - first) / Math.max(last - first, 1), y = (v) => 140 - 130 * (v - low) / Math.max(high - low, 1);
  const make = (tag, attributes, words) => {
    const e = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [k, v] of Object.entries(attributes)) e.setAttribute(k, v);
    if (words !== undefined) e.textContent = words;
    return e;
  };
  const marks = [low, (low + high) / 2, high].flatMap((v) => [
    make("line", { x1: 34, x2: 392, y1: y(v), y2: y(v) }), make("text", { x: 2, y: y(v) + 4 }, v.toFixed(0))]);
  const path = curve.map((p, i) => `${i ? "L" : "M"}${x(p[0]).toFixed(1)} ${y(p[1]).toFixed(1)}`).join("");
  $("curve").replaceChildren(...marks, make("path", { d: path }),
    make("text", { x: 34, y: 156 }, `step ${first}`), make("text", { x: 392, y: 156, "text-anchor": "end" }, `step ${last}`));
  $("curve-words").textContent = `PSNR of the fitted pixels, dB: ${values[values.length - 1].toFixed(1)} after step ${steps[steps.length - 1]}`;
}

// Another preset or budget: the fit starts again, so that the choice asks first.
function showTimes(state) {
  $("change").hidden = !look.alive || !state.changeable;
  const now = typeof state.budget === "number" ? `budget ${state.budget}` : `preset ${state.preset}`;
  const times = [...(state.presets || []).map((p) => [`preset ${p}`, `preset ${p}`]),
    ...(state.minutes || []).map((m) => [`budget ${60 * m}`, `${m} min from now`])];
  if (!times.some((t) => t[0] === now)) times.push([now, typeof state.budget === "number" ? `${state.budget / 60} min` : now]);
  const key = JSON.stringify([now, times]);
  if ($("time").dataset.shown === key) return;
  $("time").dataset.shown = key;
  $("time").replaceChildren(...times.map(([value, words]) => new Option(words, value, false, value === now)));
}

function showVerdict(verdict) {
  $("verdict").hidden = !verdict.level;
  if (verdict.level) $("verdict").replaceChildren(text("h2", `Verdict: ${verdict.level}`));
}

function show() {
  const state = look.state || {};
  document.title = `${look.alive ? `${state.percent ?? ""} % ` : ""}${look.name}`;
  $("name").textContent = look.name;
  const words = status(state);
  if ($("status").textContent !== words) $("status").textContent = words;
  const known = typeof state.percent === "number";
  $("overall").hidden = !known;
  if (known) { $("overall").firstChild.style.width = `${state.percent}%`; $("overall").setAttribute("aria-valuenow", state.percent); }
  const works = look.alive && AT_WORK.includes(state.status);
  $("steer").hidden = !works;
  const on = state.status === "running";
  for (const b of document.querySelectorAll("[data-wish]")) b.disabled = b.dataset.wish === "pause" ? !on : b.dataset.wish === "go on" ? on : false;
  showTimes(state);
  list("troubles", (look.troubles || []).map((t) => text("li", t)));
  list("links", look.alive ? [] : (look.links || []).map((l) => {
    const item = document.createElement("li"), link = text("a", `${l.words} (${l.path})`);
    link.href = new URL(l.path, BASE);
    item.append(link);
    return item;
  }));
  showVerdict(look.alive ? {} : look.verdict || {});
  showStages(state);
  showCurve(state.curve);
  list("said", [...(state.warnings || []).map((w) => text("li", `warning: ${w}`)), ...(state.notes || []).map((n) => text("li", n))]);
  document.documentElement.dataset.status = look.alive ? state.status || "silent" : "ended";
  return showPictures(state);
}

async function wish(what) {
  $("status").textContent = `Asked: ${what}. The run answers at its next checkpoint.`;
  const answer = await fetch(new URL("ask", BASE), { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ wish: what }) });
  if (!answer.ok) $("status").textContent = `Not taken: ${answer.statusText}`;
}

$("time").addEventListener("change", () => {
  const chosen = $("time").value, words = $("time").selectedOptions[0].textContent;
  delete $("time").dataset.shown; // drawn again from what the run tells
  if (confirm(`Go on with ${words}? The fit starts again from the beginning; finished stages before it are reused.`)) wish(chosen);
});
for (const b of document.querySelectorAll("[data-wish]")) b.addEventListener("click", () => wish(b.dataset.wish));
document.addEventListener("keydown", (e) => {
  if (e.key === "b" && !$("change").hidden && !e.ctrlKey && !e.metaKey && !e.altKey) { $("time").focus(); return; }
  const what = { p: "pause", " ": "go on", s: "stop after stage" }[e.key];
  if (!what || $("steer").hidden || e.ctrlKey || e.metaKey || e.altKey || e.target.closest("button, a, select")) return;
  e.preventDefault();
  wish(what);
});

const dark = () => (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
const named = () => { $("theme").textContent = dark() ? "Light" : "Dark"; };
$("theme").addEventListener("click", () => { document.documentElement.dataset.theme = dark() ? "light" : "dark"; named(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", named);
named();

async function turn() {
  try {
    const answer = await fetch(new URL("state", BASE));
    if (!answer.ok) throw new Error(answer.statusText);
    look = await answer.json();
    was = was || look.alive;
    if (was && look.whole) { location.replace(new URL("report/index.html", BASE)); return; }
    await show();
  } catch (e) {
    $("status").textContent = "`neuface view` does not answer: it has ended. The run goes on without it.";
    document.documentElement.dataset.status = "gone";
  }
  setTimeout(turn, EVERY);
}
turn();
