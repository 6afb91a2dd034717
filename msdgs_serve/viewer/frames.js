// Requests frames one at a time: small ones during motion, a full one after it.
// A full frame in progress is aborted when something moves, and the service cancels its render.

import { Refusal, received, render } from "./api.js";

const FULL_AFTER = 150; // milliseconds
const SHRINK = 0.5; // factor on the number of pixels if the service rejects it as too large
const MIN_PIXELS = 64 * 64;

export class Frames {
  /**
   * `host` has: size() of a full frame in pixels; body(); isMoving(); show(bitmap, facts); failed(error).
   */
  constructor(host, pace) {
    this.host = host;
    this.pace = pace;
    this.maxPixels = 2.5e6;
    this.inFlight = null;
    this.wanted = false;
    this.changedAt = 0;
    this.timer = 0;
    this.paused = true; // until the scene is opened
    this.refused = false; // whether the service refused the last request; the next one waits for a change
  }

  /** The view has changed. `cut`: the frame in progress is useless. */
  change({ cut = false } = {}) {
    this.changedAt = performance.now();
    this.wanted = true;
    this.shown = null;
    if (this.inFlight && (cut || this.#givesUp(this.inFlight))) this.inFlight.abort.abort();
    this.#next();
  }

  /** Revalidate the frame that is shown, by its ETag. */
  async check() {
    if (this.paused || this.refused || this.inFlight || !this.shown || this.#isMoving()) return;
    await this.#fetch({ full: true, etag: this.shown.etag });
  }

  /** Width and height of a frame in full quality. */
  fullSize() {
    const { width, height } = this.host.size();
    const scale = Math.min(1, Math.sqrt(this.maxPixels / (width * height)));
    return { width: Math.max(1, Math.floor(width * scale)), height: Math.max(1, Math.floor(height * scale)) };
  }

  #isMoving() {
    return this.host.isMoving() || performance.now() - this.changedAt < FULL_AFTER;
  }

  #givesUp({ full, pixels, asked }) {
    return full || this.pace.givesUp(pixels, (performance.now() - asked) / 1000);
  }

  #next() {
    clearTimeout(this.timer);
    if (this.paused || this.inFlight) return;
    if (this.wanted && this.#isMoving()) {
      this.wanted = false;
      this.#fetch({ full: false });
    } else if (this.wanted || (!this.shown && !this.refused)) {
      const wait = this.host.isMoving() ? FULL_AFTER : FULL_AFTER - (performance.now() - this.changedAt);
      if (wait > 0) {
        this.timer = setTimeout(() => this.#next(), wait + 1);
        return;
      }
      this.wanted = false;
      this.#fetch({ full: true });
    }
  }

  async #fetch({ full, etag }) {
    const size = full ? this.fullSize() : this.pace.size(this.fullSize());
    const body = { ...this.host.body(), ...size, ...(full ? { format: "png" } : { format: "jpeg", quality: 85 }) };
    const abort = new AbortController();
    this.inFlight = { abort, full, pixels: size.width * size.height, asked: performance.now() };
    try {
      const response = await render(body, { signal: abort.signal, etag });
      if (response.status !== 304) await this.#show(response, size, full, etag !== undefined);
    } catch (error) {
      this.#failed(error);
    } finally {
      this.inFlight = null;
    }
    this.#next();
  }

  async #show(response, size, full, isNews) {
    const { pixels, asked, abort } = this.inFlight;
    const bitmap = await createImageBitmap(await received(response.blob()));
    if (abort.signal.aborted) return;
    await new Promise(requestAnimationFrame);
    const seconds = (performance.now() - asked) / 1000;
    const stages = timings(response.headers.get("Server-Timing"));
    if (!full) this.pace.measured(pixels, seconds, (stages.draw ?? 0) + (stages.encode ?? 0));
    this.host.show(bitmap, { ...size, full, seconds, stages, isNews });
    bitmap.close();
    this.refused = false;
    if (full && !this.wanted) this.shown = { etag: response.headers.get("ETag") };
  }

  #failed(error) {
    if (error.name === "AbortError") {
      this.wanted = true;
      return;
    }
    if (error instanceof Refusal && this.#isTooLarge(error)) {
      this.maxPixels *= SHRINK;
      this.wanted = true;
      return;
    }
    if (error.retryAfter) {
      this.wanted = true;
      this.paused = true;
    } else {
      this.refused = true;
    }
    this.host.failed(error);
  }

  #isTooLarge(error) {
    const aboutSize = error.fields.some((field) => field === "width" || field === "height");
    return error.status === 422 && aboutSize && this.maxPixels > MIN_PIXELS;
  }
}

/** Return seconds by stage from a Server-Timing header. */
export function timings(header) {
  const stages = {};
  for (const part of (header ?? "").split(",")) {
    const found = /^\s*([\w-]+);dur=([\d.]+)/.exec(part);
    if (found) stages[found[1]] = Number(found[2]) / 1000;
  }
  return stages;
}
