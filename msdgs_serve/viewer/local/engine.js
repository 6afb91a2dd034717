// Draws a scene file with WebGL2. One worker poses it by onnxruntime-web, another sorts; nothing runs while nothing
// changes. A scene in which nothing moves is posed once, and its worker ends with all that it holds.

import { CHANNELS, Graphics, contextOf } from "./graphics.js";
import { inWorld, viewOf } from "./place.js";
import { Poses } from "./poses.js";
import { NEAR_PLANE } from "./shaders.js";

export { CHANNELS };

const MISSING = "A part of the page can’t be loaded."; // of a worker whose file isn’t there
const STATIC = { first: { slot: 0 }, second: { slot: 0 }, share: 0, isExact: true };

/**
 * Load a scene, and return an `Engine` that draws it, until the canvas loses its context. Rejects with an Error whose
 * message is for people if the scene, the runtime or WebGL2 can't be used.
 * @param {object} options
 * @param {HTMLCanvasElement} options.canvas  one without a context yet; it is hidden until it has a frame
 * @param {string | ArrayBuffer} options.scene  the address of the scene file, or its contents, which the caller loses; it
 *   may be gzipped
 * @param {{module: string, glue: string, binary: string}} options.runtime  addresses of onnxruntime-web's files
 *   ort.wasm.min.mjs, ort-wasm-simd-threaded.mjs and ort-wasm-simd-threaded.wasm, the last of which may be gzipped
 * @param {(bytes: {loaded: number, total: number}) => void} [options.onProgress]  `total` is 0 if it is unknown
 * @param {(error: Error) => void} [options.onError]  errors after loading
 */
export async function openEngine({ canvas, scene, runtime, onProgress = () => {}, onError = () => {} }) {
  const gl = contextOf(canvas);
  const address = (path) => String(new URL(path, document.baseURI));
  const source = typeof scene === "string" ? address(scene) : scene;
  const files = Object.fromEntries(Object.entries(runtime).map(([part, path]) => [part, address(path)]));
  const poser = worker("pose_worker.js");
  try {
    const opened = await open(poser, { kind: "open", scene: source, runtime: files }, onProgress);
    return new Engine(gl, poser, opened, onError);
  } catch (error) {
    poser.terminate();
    throw error;
  }
}

const worker = (name) => new Worker(new URL(name, import.meta.url), { type: "module" });

/** Return what the worker that poses answers when it has opened a scene. */
function open(poser, message, onProgress) {
  return new Promise((resolve, reject) => {
    poser.onerror = ({ message: text }) => reject(new Error(text || MISSING));
    poser.onmessage = ({ data }) => {
      if (data.kind === "progress") onProgress({ loaded: data.loaded, total: data.total });
      else if (data.kind === "failed") reject(new Error(data.message));
      else resolve(data);
    };
    poser.postMessage(message, typeof message.scene === "string" ? [] : [message.scene]);
  });
}

class Engine {
  #poser; // has ended if nothing moves
  #sorter;
  #graphics;
  #poses;
  #onError;
  #wanted = null; // what was asked for last
  #frame = 0; // a requested animation frame
  #sorting = null; // the view whose order is being computed, as a text
  #spent = null; // a buffer of an earlier order
  #sorted = ""; // the view that the order is for
  #waiting = []; // of `settled`

  constructor(gl, poser, { metadata, moving, changing, steps, arrays: constants }, onError) {
    this.#poser = poser;
    this.#onError = onError;
    this.metadata = inWorld(metadata);
    this.moving = moving;
    this.gaussians = moving + constants.means.length / 3;
    this.steps = steps; // number of layers that can be applied one by one; 0 if none
    this.stats = { poseMs: 0, sortMs: 0, drawMs: 0 };
    const scene = { metadata: this.metadata, moving, gaussians: this.gaussians, changing };
    this.#graphics = new Graphics(gl, scene);
    this.#graphics.setConstants(constants);
    if (!moving) poser.terminate();
    this.#sorter = worker("sort_worker.js");
    const interpolates = !metadata.plan.startsWith("frames:"); // whose Gaussians are replaced, not moved
    this.#poses = new Poses({ interpolates, range: metadata.time_range }, (pose) => this.#pose(pose));
    this.#poser.onmessage = ({ data }) => this.#takeAnswer(data);
    this.#poser.onerror = ({ message }) => onError(new Error(message || MISSING));
    this.#sorter.onmessage = ({ data }) => this.#takeOrder(data);
    this.#sorter.onerror = ({ message }) => onError(new Error(message || MISSING));
    const { means } = constants;
    this.#sorter.postMessage({ kind: "constants", means, moving }, [means.buffer]);
  }

  /**
   * Draw a view in the next animation frame.
   * @param {object} wanted
   * @param {object} wanted.camera  { fx, fy, cx, cy, width, height, camera_to_world } in the world
   * @param {number} wanted.t
   * @param {"rgb" | "alpha" | "depth"} [wanted.channel]
   * @param {[number, number]} [wanted.depthRange]  of the depth channel, world units: drawn brightest and darkest
   * @param {number | null} [wanted.steps]  number of layers to apply; null for all
   * @param {boolean} [wanted.playing]  whether `t` goes on: poses in flight are interpolated
   */
  draw({ camera, t, channel = "rgb", depthRange, steps = null, playing = false }) {
    const view = viewOf(camera, this.metadata.scene_to_world, depthRange);
    this.#wanted = { view, t, channel, steps, playing };
    this.#schedule();
  }

  /** Resolves when what was asked for last is drawn: the pose at its time, sorted for its camera. */
  settled() {
    return new Promise((resolve) => {
      this.#waiting.push(resolve);
      if (this.#wanted) this.#schedule();
    });
  }

  /** The pixels of what was asked for last. */
  async pixels() {
    await this.settled();
    this.#show(this.#posesShown());
    return this.#graphics.read();
  }

  dispose() {
    cancelAnimationFrame(this.#frame);
    this.#poser.terminate();
    this.#sorter.terminate();
    this.#graphics.dispose();
  }

  #schedule() {
    this.#frame ||= requestAnimationFrame(() => {
      this.#frame = 0;
      this.#advance();
    });
  }

  #advance() {
    if (!this.#wanted || this.#graphics.isLost) return;
    const poses = this.#posesShown();
    if (!poses) return;
    const { view } = this.#wanted;
    const order = JSON.stringify([poses, view.eye, view.rotation[2]]);
    if (order !== this.#sorted) this.#sort(poses, view, order);
    if (!this.#sorted) return;
    this.#show(poses);
    if (!poses.isExact || order !== this.#sorted) return;
    for (const resolve of this.#waiting.splice(0)) resolve();
  }

  #posesShown() {
    return this.moving ? this.#poses.at(this.#wanted, performance.now() / 1000) : STATIC;
  }

  #show(poses) {
    const start = performance.now();
    this.#graphics.draw(this.#wanted.view, poses, this.#wanted.channel);
    this.stats.drawMs = performance.now() - start;
  }

  #pose({ t, steps, slot }) {
    this.#poser.postMessage({ kind: "pose", t, steps: steps ?? undefined, slot });
  }

  #takeAnswer(data) {
    if (data.kind === "pose") this.#takePose(data);
    else {
      this.#poses.failed();
      this.#onError(new Error(data.message));
    }
  }

  #takePose({ t, steps = null, slot, arrays, milliseconds }) {
    if (this.#graphics.isLost) return;
    this.stats.poseMs = milliseconds;
    this.#graphics.setPose(slot, arrays);
    this.#sorter.postMessage({ kind: "pose", slot, means: arrays.means }, [arrays.means.buffer]);
    this.#poses.received({ t, steps, slot }, milliseconds);
    this.#schedule();
  }

  #sort({ first, second, share }, { rotation, eye }, order) {
    if (this.#sorting !== null) return;
    const axis = rotation[2];
    const shift = -axis.reduce((sum, x, i) => sum + x * eye[i], 0);
    const [spent, transfer] = [this.#spent, this.#spent ? [this.#spent] : []];
    [this.#sorting, this.#spent] = [order, null];
    const poses = { first: first.slot, second: second.slot, share };
    this.#sorter.postMessage({ kind: "sort", ...poses, axis, shift, near: NEAR_PLANE, spent }, transfer);
  }

  #takeOrder({ order, found, milliseconds }) {
    this.stats.sortMs = milliseconds;
    if (!this.#graphics.isLost) {
      this.#graphics.setOrder(order, found);
      this.#sorted = this.#sorting;
    }
    [this.#sorting, this.#spent] = [null, order.buffer];
    this.#schedule();
  }
}
