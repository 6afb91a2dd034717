// Chooses the size of frames during motion from the measured times of earlier frames, and when playback asks for them.

const PATIENCE = 0.5; // seconds of drawing after which an outdated frame is given up for a smaller one
const TARGET = 1 / 18; // seconds per frame: 15 frames per second with a margin
const MIN_PIXELS = 128 * 96;
const DRAWING_SHARE = 0.3; // minimal fraction of the target for drawing, even if posing takes longer
const SMOOTHING = 0.5; // weight of the newest measurement
const PLAYED = 1 / 30; // seconds per frame of playback, which has a request ahead

export class Pace {
  constructor() {
    this.secondsPerPixel = null;
    this.rest = 0; // seconds per frame independent of its pixels: posing, network, display
    this.due = 0; // when playback may ask for its next frame, seconds
  }

  /** Whether playback may ask for a frame at `now`, seconds. If so, the next one is due a frame's time later. */
  takesTurn(now) {
    if (now < this.due) return false;
    this.due = Math.max(this.due + PLAYED, now); // on average; what was missed isn't made up for
    return true;
  }

  /** Record a frame that took `seconds` from request to display, `drawing` of them for its pixels. */
  measured(pixels, seconds, drawing) {
    const perPixel = drawing / pixels;
    if (this.secondsPerPixel === null) {
      this.secondsPerPixel = perPixel;
      this.rest = seconds - drawing;
      return;
    }
    this.secondsPerPixel += SMOOTHING * (perPixel - this.secondsPerPixel);
    this.rest += SMOOTHING * (seconds - drawing - this.rest);
  }

  /** Record that an outdated frame isn't there after `seconds`. Return whether a smaller one should replace it. */
  givesUp(pixels, seconds) {
    const drawing = seconds - this.rest;
    if (pixels <= MIN_PIXELS || drawing <= PATIENCE) return false;
    this.measured(pixels, seconds, drawing);
    return true;
  }

  /** Return a size with the aspect ratio of `full`, and at most `full`. */
  size(full) {
    const all = full.width * full.height;
    const affordable = this.secondsPerPixel === null ? all / 4 : this.#budget() / this.secondsPerPixel;
    const pixels = Math.min(all, Math.max(affordable, MIN_PIXELS));
    const scale = steps(Math.sqrt(pixels / all));
    return { width: sized(full.width * scale), height: sized(full.height * scale) };
  }

  #budget() {
    return Math.max(TARGET - this.rest, DRAWING_SHARE * TARGET);
  }
}

/** Quantize the scale, so that the sharpness doesn't flicker. */
const steps = (scale) => (scale >= 1 ? 1 : 2 ** (Math.floor(4 * Math.log2(scale)) / 4));

const sized = (pixels) => Math.max(1, Math.floor(pixels)); // at most MIN_PIXELS in all for the smallest
