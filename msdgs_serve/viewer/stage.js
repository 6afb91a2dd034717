// The image, and the status line with its times.

import { duration } from "./numbers.js";

const MAX_PIXEL_RATIO = 2; // limit of device pixels per CSS pixel; more isn't visible

export class Stage {
  constructor(canvas, status) {
    this.canvas = canvas;
    this.status = status;
    this.context = canvas.getContext("2d", { alpha: false });
    this.rate = 0;
    this.shownAt = 0;
  }

  aspect() {
    const { clientWidth, clientHeight } = this.canvas;
    return Math.max(clientWidth, 1) / Math.max(clientHeight, 1);
  }

  /** Return the size of a full frame in pixels; stored cameras keep their aspect ratio. */
  size({ scene, camera }) {
    const sharpness = Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO);
    let [width, height] = [this.canvas.clientWidth * sharpness, this.canvas.clientHeight * sharpness];
    if (camera.sceneCamera !== null) {
      const stored = scene.cameras[camera.sceneCamera];
      const scale = Math.min(width / stored.width, height / stored.height);
      [width, height] = [stored.width * scale, stored.height * scale];
    }
    return { width: Math.max(1, Math.round(width)), height: Math.max(1, Math.round(height)) };
  }

  /** Take over a scene's background, sRGB from 0 to 1, and proportions; `isAnother`: show nothing else yet. */
  open({ background: color, view }, isAnother) {
    const background = `rgb(${color.map((x) => Math.round(255 * x)).join(" ")})`;
    const { style } = this.canvas.parentElement;
    style.setProperty("--background", background);
    style.setProperty("--proportion", Math.min(view.width / view.height, 1)); // as in Camera.half
    if (!isAnother) return;
    this.context.fillStyle = background;
    this.context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    this.canvas.dataset.shown = "";
    this.status.textContent = "\u00a0";
  }

  show(bitmap, { width, height }) {
    if (this.canvas.width !== width || this.canvas.height !== height) {
      [this.canvas.width, this.canvas.height] = [width, height];
    }
    this.context.drawImage(bitmap, 0, 0);
  }

  /** Return a new canvas that covers the image; pointers and keys pass through it. */
  addCanvas() {
    const canvas = document.createElement("canvas");
    this.canvas.after(canvas);
    return canvas;
  }

  onResize(action) {
    new ResizeObserver(action).observe(this.canvas);
  }

  /** Tell of a frame: who drew it (`label`), its size, and if known the seconds that it took, also by stage. */
  tell({ label, width, height, full, seconds, stages = {} }) {
    this.canvas.dataset.shown = full ? "full" : "moving";
    const now = performance.now();
    const between = (now - this.shownAt) / 1000;
    this.shownAt = now;
    if (between < 1) this.rate = this.rate ? this.rate + 0.2 * (1 / between - this.rate) : 1 / between;
    else this.rate = 0;
    const parts = [label, `${width} × ${height}`];
    if (seconds) parts.push(duration(seconds));
    if (!full && this.rate) parts.push(`${Math.round(this.rate)} frames/s`);
    if (full) for (const [name, taken] of Object.entries(stages)) parts.push(`${name} ${duration(taken)}`);
    this.status.textContent = parts.join(" · ");
  }
}
