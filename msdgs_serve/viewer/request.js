// What is asked of POST /render for what the page shows.

import { depthRange } from "./camera.js";

const MOTION_SHARE = 1 / 50; // of the scene's time, over which motion is shown

/** A body without size and format. `state` has the scene's detail, camera, player, layers and the view's name. */
export function frameBody({ scene, camera, player, layers, view }) {
  const some = layers.steps === null ? {} : { steps: layers.steps };
  const body = { scene: scene.name, camera: camera.spec, t: player.t, ...some };
  if (view === "depth") return { ...body, channels: ["depth"], depth_range: depthRange(camera, scene.bounds) };
  if (view === "motion") return { ...body, channels: ["motion"], ...motionTimes(player) };
  if (view === "gaussians") return { ...body, channels: ["gaussians"] };
  return body;
}

/** Motion leads to `t + dt`, which must lie in the scene's time too. */
function motionTimes(player) {
  const last = player.at(1 - MOTION_SHARE);
  const dt = player.at(1) - last;
  return { t: Math.min(player.t, last), dt };
}

/** The same for a file that holds numbers: color, alpha and depth, and what else is looked at. */
export function numbersBody(state) {
  const { depth_range: _, channels, ...body } = frameBody(state);
  const all = new Set(["rgb", "alpha", "depth", ...(channels ?? [])]);
  return { ...body, channels: [...all], format: "exr" };
}
