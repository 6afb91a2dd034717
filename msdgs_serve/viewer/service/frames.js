// Requests frames: small ones during motion, one at a time, in playback one ahead; a full one after it.
// A full frame in progress is aborted when something moves, and the service cancels its render.

import { Refusal, received, render } from "./api.js";

const FULL_AFTER = 150; // milliseconds
const SHRINK = 0.5; // factor on the number of pixels if the service rejects it as too large
const MIN_PIXELS = 64 * 64;
const STAGES = ["pose", "draw", "encode"]; // of the service, that are told
const MAX_REQUESTS = 2; // in flight during playback: the next one hides the way to the service

/** The source of pixels that the service is. */
export class Frames {
  label = "drawn by the service";
  views = ["rgb", "depth", "motion", "gaussians"];
  isSmooth = false;

  /**
   * `host` has: size() of a full frame in pixels; body(); isPlaying(); isMoving(), by itself or by playback;
   * show(bitmap, facts); failed(error).
   */
  constructor(host, pace) {
    this.host = host;
    this.pace = pace;
    this.maxPixels = 2.5e6;
    this.inFlight = new Set(); // of requests
    this.asked = 0; // number of requests so far
    this.drawn = 0; // number of the request whose frame is shown
    this.wanted = false;
    this.changedAt = 0;
    this.timer = 0;
    this.paused = true; // until the scene is opened
    this.refused = false; // whether the service refused the last request; the next one waits for a change
  }

  /** Show the scene that is open now. */
  async open() {
    this.paused = false;
    this.change({ cut: true });
  }

  /** The view has changed. `cut`: frames in progress are useless. */
  change({ cut = false } = {}) {
    this.changedAt = performance.now();
    this.wanted = true;
    this.shown = null;
    for (const request of this.inFlight) if (cut || this.#givesUp(request)) request.abort.abort();
    this.#next();
  }

  /** Ask for nothing more, and show nothing that was asked for. */
  stop() {
    this.paused = true;
    for (const { abort } of this.inFlight) abort.abort();
  }

  /** Revalidate the frame that is shown, by its ETag. */
  async check() {
    if (this.paused || this.refused || this.isBusy || !this.shown || this.#isMoving()) return;
    await this.#fetch({ full: true, size: this.fullSize(), etag: this.shown.etag });
  }

  get isBusy() {
    return this.inFlight.size > 0;
  }

  get isIdle() {
    return (this.shown || this.paused || this.refused) && !this.isBusy;
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

  #givesUp({ full, pixels, at }) {
    return full || this.pace.givesUp(pixels, (performance.now() - at) / 1000);
  }

  #next() {
    clearTimeout(this.timer);
    if (this.paused) return;
    if (this.wanted && this.#isMoving()) this.#askMoving();
    else if (!this.isBusy && (this.wanted || (!this.shown && !this.refused))) this.#askFull();
  }

  #askMoving() {
    const isPlaying = this.host.isPlaying();
    if (this.inFlight.size >= (isPlaying ? MAX_REQUESTS : 1)) return;
    if (isPlaying && !this.pace.takesTurn(performance.now() / 1000)) return; // the next tick of playback asks again
    this.wanted = false;
    this.#fetch({ full: false, size: this.pace.size(this.fullSize()) });
  }

  #askFull() {
    const wait = this.host.isMoving() ? FULL_AFTER : FULL_AFTER - (performance.now() - this.changedAt);
    if (wait > 0) {
      this.timer = setTimeout(() => this.#next(), wait + 1);
      return;
    }
    this.wanted = false;
    this.#fetch({ full: true, size: this.fullSize() });
  }

  async #fetch({ full, size, etag }) {
    const body = { ...this.host.body(), ...size, ...(full ? { format: "png" } : { format: "jpeg", quality: 85 }) };
    const request = {
      number: (this.asked += 1), full, size, pixels: size.width * size.height,
      at: performance.now(), abort: new AbortController(),
    }; // prettier-ignore
    this.inFlight.add(request);
    try {
      const response = await render(body, { signal: request.abort.signal, etag });
      if (response.status !== 304) await this.#show(response, request, etag !== undefined);
    } catch (error) {
      this.#failed(error);
    } finally {
      this.inFlight.delete(request);
    }
    this.#next();
  }

  async #show(response, { number, full, size, pixels, at, abort }, isNews) {
    const bitmap = await createImageBitmap(await received(response.blob()));
    await new Promise(requestAnimationFrame);
    if (abort.signal.aborted || number < this.drawn) return; // a later one has overtaken it
    this.drawn = number;
    const seconds = (performance.now() - at) / 1000;
    const stages = timings(response.headers.get("Server-Timing"));
    const { queue = 0, draw = 0, encode = 0 } = stages;
    if (!full) this.pace.measured(pixels, seconds - queue, draw + encode);
    const told = Object.fromEntries(STAGES.map((name) => [name, stages[name] ?? 0]));
    this.host.show(bitmap, { ...size, full, seconds, stages: told, isNews });
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
