// Bodies of POST /render for the current view.

import { depthRange } from "../camera.js";

const MOTION_SHARE = 1 / 50; // dt of the motion channel, as a fraction of the time range

/** Return a body without size and format. `state` has the scene's detail, camera, player, layers and channel. */
export function frameBody({ scene, camera, player, layers, view }) {
  const some = layers.steps === null ? {} : { steps: layers.steps };
  const body = { scene: scene.name, camera: camera.spec, t: player.t, ...some };
  if (view === "depth") return { ...body, channels: ["depth"], depth_range: depthRange(camera, scene.bounds) };
  if (view === "motion") return { ...body, channels: ["motion"], ...motionTimes(player) };
  if (view === "gaussians") return { ...body, channels: ["gaussians"] };
  return body;
}

/** Return `dt` such that `t + dt` is in the scene's time range. */
function motionTimes(player) {
  const [last, end] = [player.at(1 - MOTION_SHARE), player.at(1)];
  const dt = end - last; // rounded, so that last + dt may be more than the end
  return { t: Math.min(player.t, last), dt: last + dt > end ? dt * (1 - Number.EPSILON) : dt };
}

/** Return the body for a file of numbers: color, alpha, depth and the current channel. */
export function numbersBody(state) {
  const { depth_range: _, channels, ...body } = frameBody(state);
  const all = new Set(["rgb", "alpha", "depth", ...(channels ?? [])]);
  return { ...body, channels: [...all], format: "exr" };
}
