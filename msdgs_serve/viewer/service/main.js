// The page of the service: its scenes, and who draws them.

import { say } from "../banner.js";
import { Exports } from "../exports.js";
import { fromHash } from "../share.js";
import { Viewer } from "../viewer.js";
import { getJson, isMissing, keepKey, readKey, scenePath } from "./api.js";
import { Choice } from "./choice.js";
import { Connection } from "./connection.js";
import { drawDiagram } from "./diagram.js";
import { Frames } from "./frames.js";
import { NO_SCENES, noScene, sceneGone } from "./messages.js";
import { Pace } from "./pace.js";
import { frameBody } from "./request.js";
import { SceneList } from "./scenes.js";
import { takesOf } from "./takes.js";

const REFRESH_EVERY = 3000; // milliseconds, for changed scenes

const find = (id) => document.getElementById(id);
const viewer = new Viewer({ shown });
const connection = new Connection({ recovered: lookAgain, keyNeeded });
const scenes = new SceneList(find("scenes"), { open: choose, isIdle });
const frames = new Frames(
  {
    size: () => viewer.stage.size(viewer),
    body: () => frameBody(viewer),
    isPlaying: () => viewer.player.playing,
    isMoving: () => viewer.isMoving,
    show: (bitmap, facts) => {
      viewer.stage.show(bitmap, facts);
      viewer.shown(facts);
    },
    failed: (error) => connection.failed(error),
  },
  new Pace(),
);
const choice = new Choice(viewer, frames, (error) => connection.failed(error));
let asked = {}; // what the address or a click has asked for last
let opening = null; // the AbortController of a scene that is being opened
let needsKey = false; // whether the service has asked for a key, until the user acts

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
  say("");
  document.title = `${scene.name} · msdgs`;
  find("title").textContent = scene.name;
  scenes.mark(scene.name);
  find("docs").hidden = readKey() !== ""; // a link sends no key
  await Promise.all([choice.guarded(() => viewer.open(scene, look)), showReport(scene)]);
}

/** Show no scene, but why, and the list. */
function closeScene(reason) {
  viewer.close();
  document.title = find("title").textContent = "msdgs";
  scenes.mark(null);
  say(reason);
}

/** Open the current scene again, unless another one is being opened. */
async function reopen() {
  if (!opening) await open(viewer.scene.name);
}

async function showReport({ name, report: isThere }) {
  const section = find("report");
  const report = isThere ? await getJson(`${scenePath(name)}/report`).catch(() => null) : null;
  if (viewer.scene?.name !== name) return;
  section.hidden = !report?.points?.length;
  if (section.hidden) return;
  const { processor, threads } = report.machine;
  find("report-machine").textContent = `Measured on ${processor}, ${threads} threads.`;
  drawDiagram(find("diagram"), report, (text) => (find("report-point").textContent = text));
}

function shown({ full, isNews }) {
  if (frames.refused) say("");
  if (!full || !isNews) return;
  guarded(reopen);
  scenes.renew(viewer.scene.name);
}

/** Whether thumbnails may be rendered now. */
function isIdle() {
  return !connection.isLost && viewer.source.isIdle;
}

/** Check for added, changed and removed scenes. */
async function lookAgain() {
  if (document.hidden || connection.isLost || needsKey) return;
  await guarded(async () => {
    await scenes.refresh();
    scenes.mark(viewer.scene?.name);
    if (opening || viewer.source.isLoading) return;
    if (!viewer.scene) await start(asked);
    else if (!scenes.names.includes(viewer.scene.name)) {
      viewer.source.paused = true;
      say(sceneGone(viewer.scene.name));
    } else if (viewer.source.paused || (await isReplaced())) await reopen();
    else await frames.check();
  });
}

/** Whether the current scene has another file now; the service tells with its frames, unless it refused the last one. */
async function isReplaced() {
  if (viewer.source === frames && !frames.refused) return false;
  const { name, sha256 } = viewer.scene;
  return (await getJson(scenePath(name))).sha256 !== sha256;
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

function useKey() {
  keepKey(find("key").value.trim());
  say("");
  needsKey = false;
  guarded(start);
}

new Exports(takesOf(viewer, () => frames.fullSize()), (action) => viewer.scene && guarded(action));
find("key").value = readKey();
find("key-form").addEventListener("submit", useKey);
window.addEventListener("hashchange", () => guarded(() => start()));
setInterval(lookAgain, REFRESH_EVERY);
guarded(start);
