// Facts about the scene from its file.

const number = new Intl.NumberFormat("en");

/** Fill a <dl>. `scene` is GET /scenes/{name}. */
export function showFacts(list, scene) {
  const { moving, static: still, total } = scene.gaussians;
  const rows = [
    ["Gaussians", still ? `${number.format(total)}, ${number.format(moving)} of them moving` : number.format(total)],
    ["Deformation", scene.layers.join(", then ") || "none"],
    ["Plan", scene.plan],
    ["Error", largestError(scene.measured_error)],
    ["Time", scene.time_range.map(Number).join(" to ") + (scene.duration ? `, ${scene.duration} s` : "")],
    ["Cameras", number.format(scene.cameras.length)],
    ["Left out", scene.left_out.map(({ what, count }) => `${what}: ${number.format(count)}`).join("; ")],
    ["SHA-256", scene.sha256.slice(0, 12)],
  ];
  const shown = rows.filter(([, value]) => value);
  list.replaceChildren(...shown.flatMap(([term, value]) => [element("dt", term), element("dd", value)]));
}

/** Return the largest error of the means, in scene units if the exporter measured it so. */
function largestError({ position, means }) {
  if (position !== undefined) return `at most ${position.toExponential(1)} scene units`;
  return means === undefined ? "" : `at most ${means.toExponential(1)} of the scene’s size`;
}

function element(kind, text) {
  const made = document.createElement(kind);
  made.textContent = text;
  return made;
}
