// Chooses when the next frame is asked for, and its size, from the measured times of earlier frames.

const PATIENCE = 0.5; // seconds of drawing after which an outdated frame is given up for a smaller one
const MIN_PIXELS = 128 * 96;
const DRAWING_SHARE = 0.3; // minimal fraction of a frame's time for drawing, even if all else takes longer
const SMOOTHING = 0.5; // weight of the newest measurement

/** Seconds between frames, and how many requests are in flight at most: a second one hides the way to the service. */
export const MOVING = { between: 1 / 18, requests: 1 };
export const PLAYING = { between: 1 / 30, requests: 2 };

export class Pace {
  constructor() {
    this.secondsPerPixel = null; // drawing and encoding
    this.posing = 0; // seconds of the service's work that don't depend on the pixels
    this.way = 0; // seconds of a frame for all but the service's work: network, decoding, display
    this.due = 0; // when the next frame of a playback may be asked for, seconds
  }

  /** Whether playback may ask for a frame at `now`, seconds. If so, the next one is due a frame's time later. */
  takesTurn(now) {
    if (now < this.due) return false;
    this.due = Math.max(this.due + PLAYING.between, now); // on average; what was missed isn't made up for
    return true;
  }

  /** Record a frame that took `seconds` from request to display; `drawing` of them for its pixels, `posing` before. */
  measured(pixels, { seconds, drawing, posing = 0 }) {
    const way = Math.max(seconds - drawing - posing, 0);
    const weight = this.secondsPerPixel === null ? 1 : SMOOTHING;
    this.secondsPerPixel += weight * (drawing / pixels - this.secondsPerPixel);
    this.posing += weight * (posing - this.posing);
    this.way += weight * (way - this.way);
  }

  /** Record that an outdated frame isn't there after `seconds`. Return whether a smaller one should replace it. */
  givesUp(pixels, seconds) {
    const drawing = seconds - this.posing - this.way;
    if (pixels <= MIN_PIXELS || drawing <= PATIENCE) return false;
    this.measured(pixels, { seconds, drawing, posing: this.posing });
    return true;
  }

  /** Return a size with the aspect ratio of `full`, and at most `full`. */
  size(full, rhythm) {
    const all = full.width * full.height;
    const affordable = this.secondsPerPixel === null ? all / 4 : this.#budget(rhythm) / this.secondsPerPixel;
    const pixels = Math.min(all, Math.max(affordable, MIN_PIXELS));
    const scale = steps(Math.sqrt(pixels / all));
    return { width: sized(full.width * scale), height: sized(full.height * scale) };
  }

  /** Seconds for a frame's pixels: the service works on one frame at a time, while others are on their way. */
  #budget({ between, requests }) {
    const working = Math.min(between, requests * between - this.way);
    return Math.max(working - this.posing, DRAWING_SHARE * between);
  }
}

/** Quantize the scale, so that the sharpness doesn't flicker. */
const steps = (scale) => (scale >= 1 ? 1 : 2 ** (Math.floor(4 * Math.log2(scale)) / 4));

const sized = (pixels) => Math.max(1, Math.floor(pixels)); // at most MIN_PIXELS in all for the smallest
