// The work-precision diagram of a report: milliseconds on the x axis, PSNR of the worst frame on the y axis.

import { decibels, duration, size } from "../numbers.js";

const SVG = "http://www.w3.org/2000/svg";
const WIDTH = 320;
const HEIGHT = 230;
const LEFT = 44;
const RIGHT = 12;
const TOP = 10;
const BOTTOM = 36;
const DB_STEP = 10;
const MAX_DB = 110; // dB; exact plans are drawn here
const PLACES = [[1, 1.5, 2, 3, 4, 5, 6, 7, 8], [1, 2, 5], [1]]; // ticks per decade, as many as fit
const MAX_TICKS = 6;
const KINDS = ["network", "prefix", "compact"];

/** Draw into an <svg>; `tell(text)` is called with a description of the point that is focused or nearest to the pointer. */
export function drawDiagram(svg, report, tell) {
  const points = report.points.map(pointOf).sort((a, b) => a.milliseconds - b.milliseconds);
  const across = scale(points.map((point) => Math.log(point.milliseconds)), [LEFT + 8, WIDTH - RIGHT - 8]);
  const limits = report.min_psnr === null ? [] : [report.min_psnr]; // none if only bytes are limited
  const upwards = scale([...points.map((point) => point.psnr), ...limits], [TOP + 8, HEIGHT - BOTTOM - 8]);
  const x = (milliseconds) => across(Math.log(milliseconds));
  svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  svg.replaceChildren(
    ...timeAxis(points, x),
    ...errorAxis(points, upwards),
    ...limits.flatMap((db) => allowed(db, upwards(db))),
    frontLine(points, x, upwards),
    ...points.map((point) => dot(point, x(point.milliseconds), upwards(point.psnr), tell)),
  );
  svg.onpointermove = svg.onclick = (event) => {
    const box = svg.getBoundingClientRect();
    const [right, down] = [event.clientX - box.left, event.clientY - box.top].map((length) => (length * WIDTH) / box.width);
    const away = (point) => Math.hypot(x(point.milliseconds) - right, upwards(point.psnr) - down);
    tell(sentence(points.reduce((nearest, point) => (away(point) < away(nearest) ? point : nearest))));
  };
  tell(sentence(points.find((point) => point.chosen) ?? points[0]));
}

function pointOf(point) {
  return {
    plan: point.plan,
    kind: point.plan.split(":")[0],
    front: point.front,
    chosen: point.chosen,
    pruned: point.pruning_db,
    milliseconds: point.milliseconds.total.min,
    psnr: Math.min(point.error.psnr_worst ?? MAX_DB, MAX_DB),
    bytes: point.bytes,
  };
}

/** Return a linear scale from values to coordinates. */
function scale(values, [first, last]) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  return (value) => (high > low ? first + ((value - low) / (high - low)) * (last - first) : (first + last) / 2);
}

function timeAxis(points, x) {
  const [fastest, slowest] = [points[0].milliseconds, points.at(-1).milliseconds];
  const inside = PLACES.map((decade) => ticksOf(decade, fastest, slowest)).find((ticks) => ticks.length <= MAX_TICKS);
  const marked = inside?.length > 1 ? inside : [fastest, slowest].map((place) => Number(place.toPrecision(2)));
  const ticks = marked.flatMap((place) => [
    make("line", { class: "grid", x1: x(place), x2: x(place), y1: TOP, y2: HEIGHT - BOTTOM }),
    make("text", { class: "tick", x: x(place), y: HEIGHT - BOTTOM + 14, "text-anchor": "middle" }, `${place}`),
  ]);
  const name = make("text", { class: "axis", x: (LEFT + WIDTH - RIGHT) / 2, y: HEIGHT - 4, "text-anchor": "middle" });
  name.textContent = "milliseconds a frame";
  return [...ticks, name];
}

function ticksOf(decade, low, high) {
  const powers = [-1, 0, 1, 2, 3, 4];
  const all = powers.flatMap((power) => decade.map((place) => Number((place * 10 ** power).toPrecision(2))));
  return all.filter((place) => place >= low && place <= high);
}

function errorAxis(points, y) {
  const values = points.map((point) => point.psnr);
  const ticks = [];
  for (let db = DB_STEP * Math.ceil(Math.min(...values) / DB_STEP); db <= Math.max(...values); db += DB_STEP) {
    ticks.push(make("line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: y(db), y2: y(db) }));
    ticks.push(make("text", { class: "tick", x: LEFT - 6, y: y(db) + 4, "text-anchor": "end" }, `${db} dB`));
  }
  return ticks;
}

function allowed(db, y) {
  return [
    make("line", { class: "allowed", x1: LEFT, x2: WIDTH - RIGHT, y1: y, y2: y }),
    make("text", { class: "tick", x: WIDTH - RIGHT, y: y - 4, "text-anchor": "end" }, `allowed: ${db} dB`),
  ];
}

function frontLine(points, x, y) {
  const front = points.filter((point) => point.front);
  const steps = front.map((point, i) => `${i ? `H${x(point.milliseconds)}V` : `M${x(point.milliseconds)} `}${y(point.psnr)}`);
  return make("path", { class: "front", d: steps.join("") });
}

function dot(point, x, y, tell) {
  const kind = KINDS.includes(point.kind) ? point.kind : "other";
  const drawn = make("circle", {
    class: `dot ${kind}${point.chosen ? " chosen" : ""}${point.front ? "" : " behind"}`,
    cx: x, cy: y, r: point.chosen ? 6 : 4.5,
    tabindex: 0, role: "img", "aria-label": sentence(point),
  }); // prettier-ignore
  drawn.addEventListener("focus", () => tell(sentence(point)));
  return drawn;
}

function sentence(point) {
  const pruned = point.pruned === null ? "all of it" : `pruned to ${decibels(point.pruned)}`;
  const error = point.psnr >= MAX_DB ? "exact" : `${decibels(point.psnr)} in the worst frame`;
  const served = point.chosen ? "Chosen: " : "";
  return `${served}${point.plan}, ${pruned}. ${duration(point.milliseconds / 1000)}, ${error}, ${size(point.bytes)}.`;
}

function make(kind, attributes, text = "") {
  const made = document.createElementNS(SVG, kind);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.textContent = text;
  return made;
}
