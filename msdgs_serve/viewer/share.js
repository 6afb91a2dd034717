// The view as a URL; texts and files for other programs.

import { short } from "./camera.js";

/** Return the address of the page with a view. */
export const linkTo = (state) => new URL(toHash(state), location.href).href;

/** Copy a text. Return whether that worked; browsers may forbid both ways. */
export async function copy(text) {
  try {
    await navigator.clipboard.writeText(text); // without HTTPS only for pages from this machine
    return true;
  } catch {
    return copySelected(text);
  }
}

/** Copy a text by the command that needs no permission, but a selection. */
function copySelected(text) {
  const focused = document.activeElement;
  const field = document.createElement("textarea");
  field.value = text;
  field.className = "unseen";
  document.body.append(field);
  field.select();
  const isCopied = document.execCommand("copy");
  field.remove();
  focused?.focus({ preventScroll: true });
  return isCopied;
}

/** Save a Blob as a file. */
export function save(contents, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(contents);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/** Return the view as the fragment of the URL. */
export function toHash({ scene, camera, player, layers, view }) {
  const { azimuth, elevation, distance, target, sceneCamera } = camera;
  const lengths = [distance, ...target].map((x) => short(x, distance));
  const free = [short(azimuth), short(elevation), ...lengths].join(",");
  const at = sceneCamera === null ? { at: free, ...camera.ownLens } : { camera: sceneCamera };
  const steps = layers.steps === null ? {} : { steps: layers.steps };
  return `#${new URLSearchParams({ scene: scene.name, t: player.t, ...steps, view, ...at })}`.replaceAll("%2C", ",");
}

/** Parse a fragment; missing and invalid values are left out. */
export function fromHash(hash) {
  const given = new URLSearchParams(hash.slice(1));
  const at = (given.get("at") ?? "").split(",").map(Number);
  const number = (name) => (given.has(name) ? Number(given.get(name)) : NaN);
  const [t, steps, sceneCamera, fov, proportion] = ["t", "steps", "camera", "fov", "proportion"].map(number);
  return {
    scene: given.get("scene"),
    view: given.get("view"),
    t: Number.isFinite(t) ? t : null,
    steps: Number.isFinite(steps) ? steps : null,
    sceneCamera: Number.isInteger(sceneCamera) ? sceneCamera : null,
    at: at.length === 6 && at.every(Number.isFinite) && at[2] > 0 ? at : null,
    lens: { fov: fov > 0 && fov < 180 ? fov : undefined, proportion: proportion > 0 ? proportion : undefined },
  };
}
