// The source of pixels that this browser is: it poses and draws the scene's file.

import { say, unsay } from "../banner.js";
import { depthRange, pinhole } from "../camera.js";
import { size } from "../numbers.js";
import { CHANNELS, openEngine } from "./engine.js";

const REST_AFTER = 150; // milliseconds without a change, after which a frame counts as one that stays
const RUNTIME_FILES = ["ort.js", "ort-wasm.js", "ort-wasm.wasm.gz"]; // as msdgs_serve/browser.py names them
const LOST = "The browser has taken the graphics from this page. It goes on when they are back.";

export class LocalSource {
  label = "drawn here";
  views = CHANNELS;
  isSmooth = true;
  refused = false;

  /**
   * @param {object} viewer
   * @param {object} files
   * @param {string} files.runtime  address of the folder with onnxruntime-web's files, a slash at its end
   * @param {(scene, tell) => Promise<ArrayBuffer>} files.file  the contents of a scene's file; it calls
   *   tell({ loaded, total }), bytes
   */
  constructor(viewer, { runtime, file }) {
    const [module, glue, binary] = RUNTIME_FILES.map((name) => runtime + name);
    Object.assign(this, { viewer, file, runtime: { module, glue, binary } });
    this.progress = document.getElementById("loading");
    this.number = 0; // of the scene that was opened last
    this.engine = null;
    this.canvas = null;
    this.stop();
  }

  /** Show the viewer's scene. Rejects with an Error for people if it can't be loaded or drawn. */
  async open(scene) {
    const number = (this.number += 1);
    if (this.sha256 !== scene.sha256) await this.#load(scene, number);
    if (number !== this.number) return;
    this.paused = false;
    this.change();
    await this.#rest(this.engine);
  }

  /** Draw the viewer's view in the next animation frame. */
  change() {
    if (!this.engine || this.paused) return;
    const { player, layers, view, scene, camera } = this.viewer;
    this.engine.draw({
      camera: pinhole(camera, scene, this.fullSize()),
      t: player.t,
      channel: view,
      depthRange: depthRange(camera, scene.bounds),
      steps: layers.steps,
      playing: player.playing,
    });
    this.isIdle = false;
    clearTimeout(this.timer);
    if (this.viewer.isMoving) this.#tell(false);
    else this.timer = setTimeout(() => this.#rest(this.engine), REST_AFTER);
  }

  stop() {
    this.number += 1;
    this.paused = true;
    this.isIdle = true;
    this.#close();
    unsay(this.problem);
  }

  /** Width and height of the image in pixels. */
  fullSize() {
    return this.viewer.stage.size(this.viewer);
  }

  /** The image of the viewer's view, a Blob in PNG. */
  async png() {
    if (!this.engine) throw new Error("There is no image yet.");
    const pixels = await this.engine.pixels();
    const image = new OffscreenCanvas(pixels.width, pixels.height);
    image.getContext("2d").putImageData(pixels, 0, 0);
    return image.convertToBlob();
  }

  async #load(scene, number) {
    this.#close();
    this.isLoading = true;
    this.progress.hidden = false;
    try {
      const contents = await this.file(scene, (bytes) => this.#showProgress(bytes));
      if (number !== this.number) return;
      const canvas = this.viewer.stage.addCanvas();
      this.canvas = canvas;
      canvas.addEventListener("webglcontextlost", (event) => {
        if (canvas !== this.canvas) return; // `#close` gave it back
        event.preventDefault(); // so that it is restored
        this.#fail(LOST);
      });
      canvas.addEventListener("webglcontextrestored", () => canvas === this.canvas && this.#reload());
      const engine = await openEngine({
        canvas,
        scene: contents,
        runtime: this.runtime,
        onProgress: (bytes) => this.#showProgress(bytes),
        onError: (error) => this.#fail(error.message),
      });
      if (number !== this.number) return engine.dispose();
      this.engine = engine;
      this.sha256 = scene.sha256;
    } catch (error) {
      if (number !== this.number) return;
      this.#close();
      throw error;
    } finally {
      if (number === this.number) {
        this.isLoading = false;
        this.progress.hidden = true;
      }
    }
  }

  /** Open the scene again, all of whose arrays were lost with the graphics. */
  async #reload() {
    unsay(this.problem);
    this.sha256 = null;
    await this.open(this.viewer.scene).catch((error) => this.#fail(error.message));
  }

  /** Say what is wrong, as long as this source draws. */
  #fail(text) {
    this.problem = text;
    say(text);
  }

  #close() {
    clearTimeout(this.timer);
    this.engine?.dispose();
    this.canvas?.remove();
    this.engine = this.canvas = this.sha256 = null;
    this.isLoading = false;
    this.progress.hidden = true;
  }

  #showProgress({ loaded, total }) {
    this.progress.max = total || 1;
    if (total) this.progress.value = loaded;
    else this.progress.removeAttribute("value");
    const amount = `${size(loaded)}${total ? ` of ${size(total)}` : ""}`;
    this.viewer.stage.status.textContent = loaded === total ? "Opening the scene…" : `Loading ${amount}`;
  }

  async #rest(engine) {
    await engine.settled();
    if (engine !== this.engine || this.viewer.isMoving) return;
    this.isIdle = true;
    this.#tell(true);
  }

  #tell(full) {
    this.viewer.shown({ ...this.fullSize(), full });
  }
}
