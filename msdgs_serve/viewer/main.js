// The page: its state and the connections between its parts.

import { call, getJson, keepKey, readKey, render, scenePath } from "./api.js";
import { Camera } from "./camera.js";
import { Connection } from "./connection.js";
import { Controls } from "./controls.js";
import { drawDiagram } from "./diagram.js";
import { showFacts } from "./facts.js";
import { Frames } from "./frames.js";
import { Layers } from "./layers.js";
import { Pace } from "./pace.js";
import { Player } from "./player.js";
import { frameBody, numbersBody } from "./request.js";
import { SceneList } from "./scenes.js";
import { copy, curlCommand, fromHash, save, toHash } from "./share.js";
import { Stage } from "./stage.js";
import { Timeline } from "./timeline.js";

const REFRESH_EVERY = 3000; // milliseconds, for changed scenes
const NOTICE_FOR = 2500;
const VIEWS = ["rgb", "depth", "motion", "gaussians"];

const find = (id) => document.getElementById(id);
const layers = new Layers({ changed: () => changed() });
const state = { scene: null, camera: null, player: new Player(), layers, view: "rgb" };
const pace = new Pace();
const stage = new Stage(find("image"), find("status"));
const timeline = new Timeline(state.player, { changed: () => changed(), started: run });
const connection = new Connection(find("banner"), { recovered: lookAgain, keyNeeded });
const scenes = new SceneList(find("scenes"), { open: (name) => guarded(() => open(name)), isIdle });
const controls = new Controls(find("image"), { camera: () => state.camera, moved: () => moved(), command });
const frames = new Frames(
  {
    size: () => stage.size(state),
    body: () => frameBody(state),
    isMoving: () => state.player.playing || controls.flying.size > 0,
    show,
    failed: (error) => connection.failed(error),
  },
  pace,
);
let opening = null; // the AbortController of a scene that is being opened
let needsKey = false; // whether the service has asked for a key, until the user acts
let isFast = false;
let running = 0;

async function open(name, look = {}) {
  opening?.abort();
  const { signal } = (opening = new AbortController());
  const scene = await getJson(scenePath(name), { signal }).finally(() => signal.aborted || (opening = null));
  needsKey = false;
  const isAnother = state.scene?.name !== name;
  state.scene = scene;
  state.player.range = scene.time_range;
  state.player.duration = scene.duration;
  if (isAnother) {
    state.camera = new Camera(scene.view);
    state.camera.aspect = stage.aspect();
    state.player.seek(0);
    layers.set(null);
  } else state.camera.setView(scene.view);
  layers.open(scene.steps);
  const { sceneCamera } = state.camera;
  state.camera.sceneCamera = null; // unless the file still has it, maybe with another pose
  applyLook({ sceneCamera });
  applyLook(look);
  describe();
  connection.say("");
  frames.paused = false;
  frames.change({ cut: true });
  await showReport(scene);
}

/** Open the current scene again, unless another one is being opened. */
async function reopen() {
  if (!opening) await open(state.scene.name);
}

function applyLook({ t = null, steps, at = null, sceneCamera = null, view = null }) {
  if (t !== null) state.player.seekTime(t);
  if (steps !== undefined) layers.set(steps); // null in an address without them: all
  if (at) state.camera.reset();
  if (at) [state.camera.azimuth, state.camera.elevation, state.camera.distance] = at;
  if (at) state.camera.target = at.slice(3);
  if (sceneCamera in state.scene.cameras) state.camera.take(state.scene.cameras[sceneCamera], sceneCamera);
  if (VIEWS.includes(view)) state.view = view;
}

function describe() {
  const { scene } = state;
  document.title = `${scene.name} · msdgs`;
  find("title").textContent = scene.name;
  scenes.mark(scene.name);
  stage.background(scene.background);
  showFacts(find("facts"), scene);
  const options = scene.cameras.map((camera, i) => new Option(camera.name, i));
  find("camera").replaceChildren(new Option("Free view", ""), ...options);
  find("camera").hidden = scene.cameras.length === 0;
  find("camera").value = state.camera.sceneCamera ?? "";
  find("view").elements.view.value = state.view;
  find("docs").hidden = readKey() !== ""; // a link sends no key
  timeline.show();
}

async function showReport({ name, report: isThere }) {
  const section = find("report");
  const report = isThere ? await getJson(`${scenePath(name)}/report`).catch(() => null) : null;
  if (state.scene.name !== name) return;
  section.hidden = !report?.points?.length;
  if (section.hidden) return;
  const { processor, threads } = report.machine;
  find("report-machine").textContent = `Measured on ${processor}, ${threads} threads.`;
  drawDiagram(find("diagram"), report, (text) => (find("report-point").textContent = text));
}

/** The view has changed. */
function changed() {
  if (state.camera) frames.change();
}

function moved() {
  find("camera").value = state.camera.sceneCamera ?? "";
  changed();
  if (controls.flying.size > 0) run();
}

function show(bitmap, facts) {
  stage.show(bitmap, facts);
  if (frames.refused) connection.say("");
  if (!facts.full) return;
  history.replaceState(null, "", toHash(state));
  if (facts.isNews) guarded(reopen);
  if (facts.isNews) scenes.renew(state.scene.name);
}

/** Whether thumbnails may be rendered now. */
function isIdle() {
  return !connection.isLost && (frames.shown || frames.paused || frames.refused) && !frames.inFlight;
}

/** Advance playback and flight with animation frames, while either is active. */
function run() {
  if (running) return;
  let before = performance.now();
  const tick = (now) => {
    const seconds = Math.min(Math.max(now - before, 0) / 1000, 0.5);
    before = now;
    if (state.player.playing && !connection.isLost) {
      state.player.advance(seconds);
      timeline.show();
      changed();
    }
    const isFlying = controls.advance(seconds, isFast);
    running = state.player.playing || isFlying ? requestAnimationFrame(tick) : 0;
  };
  running = requestAnimationFrame(tick);
}

function command(key) {
  const place = VIEWS[Number(key) - 1];
  if (place) setView(place);
  else if (key === " ") timeline.toggle();
  else if (key === ",") timeline.step(-1);
  else if (key === ".") timeline.step(1);
  else if (key === "r") resetCamera();
  else if (key === "?") find("help").showModal();
  else return false;
  return true;
}

function setView(view) {
  state.view = view;
  find("view").elements.view.value = view;
  frames.change({ cut: true });
}

function resetCamera() {
  if (!state.camera) return;
  state.camera.reset();
  moved();
}

/** Check for added, changed and removed scenes. */
async function lookAgain() {
  if (document.hidden || connection.isLost || needsKey) return;
  await guarded(async () => {
    await scenes.refresh();
    scenes.mark(state.scene?.name);
    if (opening) return;
    if (!state.scene) await start();
    else if (!scenes.names.includes(state.scene.name)) {
      frames.paused = true;
      connection.say(`${state.scene.name} is gone.`);
    } else if (frames.paused || (await isReplaced())) await reopen();
    else await frames.check();
  });
}

/** Whether the current scene, a frame of which was refused, has another file now. */
async function isReplaced() {
  const { name, sha256 } = state.scene;
  return frames.refused && (await getJson(scenePath(name))).sha256 !== sha256;
}

async function start() {
  const look = fromHash(location.hash); // a frame that arrives meanwhile replaces it
  await scenes.refresh();
  const name = scenes.names.includes(look.scene) ? look.scene : scenes.names[0];
  if (name === undefined) connection.say("No scenes. Files that are added to the service’s folder appear here.");
  else await open(name, look);
}

async function guarded(action) {
  try {
    await action();
  } catch (error) {
    if (error.name !== "AbortError") connection.failed(error);
  }
}

function keyNeeded() {
  needsKey = true;
  find("key-dialog").showModal();
}

function notice(text) {
  find("notice").textContent = text;
  setTimeout(() => find("notice").textContent === text && (find("notice").textContent = ""), NOTICE_FOR);
}

async function takeAlong(kind) {
  const size = frames.fullSize();
  if (kind === "curl") {
    const text = curlCommand({ ...frameBody(state), ...size, format: "png" });
    if (await copy(text)) return notice("Copied.");
    find("command").value = text;
    find("command-dialog").showModal();
    find("command").select();
    return undefined;
  }
  const { name } = state.scene;
  if (kind === "onnx") return save(await call(`${scenePath(name)}/file`), `${name}.onnx`);
  const body = kind === "exr" ? numbersBody(state) : { ...frameBody(state), format: kind };
  return save(await render({ ...body, ...size }), `${name}-${state.player.t}.${kind}`);
}

function listen() {
  find("view").addEventListener("change", (event) => setView(event.target.value));
  find("reset").addEventListener("click", resetCamera);
  find("camera").addEventListener("change", ({ target }) => {
    if (target.value === "") return;
    const index = Number(target.value);
    state.camera.take(state.scene.cameras[index], index);
    moved();
  });
  for (const button of document.querySelectorAll("[data-take]")) {
    button.addEventListener("click", () => state.scene && guarded(() => takeAlong(button.dataset.take)));
  }
  for (const button of document.querySelectorAll("[data-opens]")) {
    button.addEventListener("click", () => find(button.dataset.opens).showModal());
  }
  find("key-form").addEventListener("submit", () => {
    keepKey(find("key").value.trim());
    connection.say("");
    needsKey = false;
    guarded(start);
  });
  for (const event of ["keydown", "keyup"]) document.addEventListener(event, ({ shiftKey }) => (isFast = shiftKey));
  window.addEventListener("hashchange", () => guarded(start));
  stage.onResize(() => {
    if (state.camera) state.camera.aspect = stage.aspect();
    changed();
  });
  setInterval(lookAgain, REFRESH_EVERY);
}

find("key").value = readKey();
listen();
guarded(start);
