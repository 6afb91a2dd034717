// The page of a folder of files: one scene, which is drawn here.

import { say } from "../banner.js";
import { Exports } from "../exports.js";
import { LocalSource } from "../local/source.js";
import { fromHash, linkTo } from "../share.js";
import { Viewer } from "../viewer.js";
import { description, sceneFile } from "./files.js";

const RUNTIME = "onnxruntime-web/";
const IS_CALM = matchMedia("(prefers-reduced-motion: reduce)").matches;

let plays = false; // from the first frame on, before it puts its time into the address
const viewer = new Viewer({ shown });
const source = new LocalSource(viewer, { runtime: RUNTIME, file: sceneFile });
viewer.use(source);

async function start() {
  const look = fromHash(location.hash);
  const scene = await description();
  plays = scene.changes && look.t === null && !IS_CALM;
  await viewer.open(scene, look);
}

function shown() {
  document.getElementById("preview")?.remove();
  if (plays && !viewer.player.playing) viewer.timeline.toggle();
  plays = false;
}

async function guarded(action) {
  try {
    await action();
  } catch (error) {
    say(error.message);
  }
}

/** The functions of Exports. */
const takes = {
  link: () => linkTo(viewer),
  png: async () => {
    viewer.pause();
    return { contents: await source.png(), name: `${viewer.scene.name}-${viewer.player.t}.png` };
  },
  onnx: async () => ({ contents: new Blob([await sceneFile(viewer.scene)]), name: `${viewer.scene.name}.onnx` }),
};

document.body.classList.toggle("embedded", window.parent !== window);
new Exports(takes, (action) => viewer.scene && guarded(action));
window.addEventListener("hashchange", () => viewer.scene && guarded(() => viewer.open(viewer.scene, fromHash(location.hash))));
guarded(start);
