// Facts about the scene from its file.

import { count, decibels, duration, inRange, plain, size } from "./numbers.js";

const PLANS = {
  network: "all layers",
  prefix: "the first layers",
  compact: "fitted curves",
  keyframes: "splines through the frames",
  frames: "the nearest of the frames",
};

/** Fill a <dl>. `scene` is GET /scenes/{name}. */
export function showFacts(list, scene) {
  const rows = [
    ["Gaussians", [gaussians(scene)]],
    ["Time", [time(scene)]],
    ["Deformation", [scene.changes ? inTurn(scene.layers) : "none, the scene is static"]],
    ["Plan", [scene.changes && plan(scene)]],
    ["Error", [largestError(scene)]],
    ["Cameras", [scene.cameras.length && count(scene.cameras.length)]],
    ["Left out", scene.left_out.map(leftOut)],
    ["SHA-256", [scene.sha256.slice(0, 12)]],
  ];
  const shown = rows.map(([term, values]) => [term, values.filter(Boolean)]).filter(([, values]) => values.length);
  const items = shown.flatMap(([term, values]) => [element("dt", term), ...values.map((text) => element("dd", text))]);
  list.replaceChildren(...items);
}

function gaussians({ gaussians: { moving, static: still, total }, motion }) {
  if (!motion) return count(total);
  return still ? `${count(total)}, ${count(moving)} of them moving` : `${count(total)}, all moving`;
}

function time({ changes, time_range: range, duration: seconds }) {
  if (!changes) return "";
  const [first, last] = range.map((t) => Number(inRange(t, range[1] - range[0])));
  return `${first} to ${last}${seconds ? `, ${duration(seconds)}` : ""}`;
}

/** ["spline", "mlp", "mlp"] → "spline, then 2 × mlp" */
function inTurn(layers) {
  const runs = [];
  for (const kind of layers) {
    if (runs.at(-1)?.kind === kind) runs.at(-1).length += 1;
    else runs.push({ kind, length: 1 });
  }
  return runs.map(({ kind, length }) => (length > 1 ? `${length} × ${kind}` : kind)).join(", then ");
}

function plan({ plan: name }) {
  const meaning = PLANS[name.split(":")[0]];
  return meaning ? `${name} (${meaning})` : name;
}

/** Return the error of the worst frame if frames were compared, else that of the means. */
function largestError({ measured_error: { rendered, position, means }, left_out: parts }) {
  const ofParts = parts.map((part) => part?.worst_frame_db).filter(Number.isFinite);
  const psnr = rendered?.psnr_worst ?? (ofParts.length ? Math.min(...ofParts) : null);
  if (Number.isFinite(psnr)) return `${decibels(psnr)} in the worst frame`;
  if (Number.isFinite(position)) return position ? `at most ${plain(position)} world units` : "none";
  if (Number.isFinite(means)) return means ? `at most ${plain(100 * means)} % of the scene’s size` : "none";
  return "";
}

function leftOut(part) {
  if (part?.rule === "float32") return `${size(part.count)} of ${size(part.of)}, by fewer bits per number`;
  return part?.what && `${part.what}: ${count(part.count)} of ${count(part.of)}`;
}

function element(kind, text) {
  const made = document.createElement(kind);
  made.textContent = text;
  return made;
}
