// The page: its state and the connections between its parts.

import { getJson, isMissing, keepKey, readKey, scenePath } from "./api.js";
import { Camera } from "../camera.js";
import { Connection } from "./connection.js";
import { Controls } from "../controls.js";
import { drawDiagram } from "./diagram.js";
import { Exports } from "./exports.js";
import { showFacts } from "../facts.js";
import { Frames } from "./frames.js";
import { Layers } from "../layers.js";
import { NO_SCENES, noScene, noView, sceneGone } from "./messages.js";
import { Pace } from "./pace.js";
import { Player } from "../player.js";
import { frameBody } from "./request.js";
import { SceneList } from "./scenes.js";
import { fromHash, toHash } from "../share.js";
import { Stage } from "../stage.js";
import { Timeline } from "../timeline.js";
import { Views } from "../views.js";

const REFRESH_EVERY = 3000; // milliseconds, for changed scenes

const find = (id) => document.getElementById(id);
const layers = new Layers({ changed: () => changed() });
const views = new Views(find("view"), setView);
const state = {
  scene: null, camera: null, player: new Player(), layers,
  get view() { return views.current; },
}; // prettier-ignore
const pace = new Pace();
const stage = new Stage(find("image"), find("status"));
const timeline = new Timeline(state.player, { changed: () => changed(), started: run });
const connection = new Connection(find("banner"), { recovered: lookAgain, keyNeeded });
const scenes = new SceneList(find("scenes"), { open: choose, isIdle });
const controls = new Controls(find("image"), { camera: () => state.camera, moved: () => moved(), command });
const frames = new Frames(
  {
    size: () => stage.size(state),
    body: () => frameBody(state),
    isPlaying: () => state.player.playing,
    isMoving: () => state.player.playing || controls.flying.size > 0,
    show,
    failed: (error) => connection.failed(error),
  },
  pace,
);
new Exports({ state: () => state, size: () => frames.fullSize(), guarded });
let asked = {}; // what the address or a click has asked for last
let opening = null; // the AbortController of a scene that is being opened
let needsKey = false; // whether the service has asked for a key, until the user acts
let isFast = false;
let running = 0;

function choose(name) {
  asked = { scene: name };
  guarded(() => open(name));
}

async function open(name, look = {}) {
  opening?.abort();
  const { signal } = (opening = new AbortController());
  let scene;
  try {
    scene = await getJson(scenePath(name), { signal });
  } catch (error) {
    if (isMissing(error)) return closeScene(noScene(name));
    throw error;
  } finally {
    if (!signal.aborted) opening = null;
  }
  needsKey = false;
  const isAnother = state.scene?.name !== name;
  state.scene = scene;
  document.body.classList.remove("empty");
  state.player.open(scene);
  timeline.open();
  stage.open(scene.background, isAnother);
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
  const wanted = look.view ?? views.current;
  notice(views.open(scene, wanted) ? "" : noView(wanted));
  describe();
  connection.say("");
  frames.paused = false;
  frames.change({ cut: true });
  return showReport(scene);
}

/** Show no scene, but why, and the list. */
function closeScene(reason) {
  state.scene = state.camera = null;
  state.player.playing = false;
  frames.stop();
  document.body.classList.add("empty");
  document.title = find("title").textContent = "msdgs";
  scenes.mark(null);
  notice("");
  connection.say(reason);
}

/** Open the current scene again, unless another one is being opened. */
async function reopen() {
  if (!opening) await open(state.scene.name);
}

function applyLook({ t = null, steps, at = null, sceneCamera = null }) {
  if (t !== null) state.player.seekTime(t);
  if (steps !== undefined) layers.set(steps); // null in an address without them: all
  if (at) state.camera.reset();
  if (at) [state.camera.azimuth, state.camera.elevation, state.camera.distance] = at;
  if (at) state.camera.target = at.slice(3);
  if (sceneCamera in state.scene.cameras) state.camera.take(state.scene.cameras[sceneCamera], sceneCamera);
}

function describe() {
  const { scene } = state;
  document.title = `${scene.name} · msdgs`;
  find("title").textContent = scene.name;
  scenes.mark(scene.name);
  showFacts(find("facts"), scene);
  const options = scene.cameras.map((camera, i) => new Option(camera.name, i));
  find("camera").replaceChildren(new Option("Free view", ""), ...options);
  find("camera").hidden = scene.cameras.length === 0;
  find("camera").value = state.camera.sceneCamera ?? "";
  find("docs").hidden = readKey() !== ""; // a link sends no key
  timeline.show();
}

async function showReport({ name, report: isThere }) {
  const section = find("report");
  const report = isThere ? await getJson(`${scenePath(name)}/report`).catch(() => null) : null;
  if (state.scene?.name !== name) return;
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
  return !connection.isLost && (frames.shown || frames.paused || frames.refused) && !frames.isBusy;
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
  const view = views.names[Number(key) - 1];
  const { changes } = state.player;
  if (view) setView(view);
  else if (key === " " && changes) timeline.toggle();
  else if (key === "," && changes) timeline.step(-1);
  else if (key === "." && changes) timeline.step(1);
  else if (key === "r") resetCamera();
  else if (key === "?") find("help").showModal();
  else return false;
  return true;
}

function setView(view) {
  notice(views.show(view) ? "" : noView(view));
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
    if (!state.scene) await start(asked);
    else if (!scenes.names.includes(state.scene.name)) {
      frames.paused = true;
      connection.say(sceneGone(state.scene.name));
    } else if (frames.paused || (await isReplaced())) await reopen();
    else await frames.check();
  });
}

/** Whether the current scene, a frame of which was refused, has another file now. */
async function isReplaced() {
  const { name, sha256 } = state.scene;
  return frames.refused && (await getJson(scenePath(name))).sha256 !== sha256;
}

/** Show what the address asks for, or say that it isn't there. */
async function start(look = fromHash(location.hash)) {
  asked = look; // a frame that arrives meanwhile replaces the address
  await scenes.refresh();
  const { names } = scenes;
  if (names.length === 0) return closeScene(NO_SCENES);
  const name = look.scene === null ? names[0] : scenes.find(look.scene);
  return name === undefined ? closeScene(noScene(look.scene)) : open(name, look);
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
}

function listen() {
  find("reset").addEventListener("click", resetCamera);
  find("camera").addEventListener("change", ({ target }) => {
    if (target.value === "") return;
    const index = Number(target.value);
    state.camera.take(state.scene.cameras[index], index);
    moved();
  });
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
  window.addEventListener("hashchange", () => guarded(() => start()));
  stage.onResize(() => {
    if (state.camera) state.camera.aspect = stage.aspect();
    if (!frames.refused) changed(); // a message that appears resizes the image too
  });
  setInterval(lookAgain, REFRESH_EVERY);
}

find("key").value = readKey();
listen();
guarded(start);
