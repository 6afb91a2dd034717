// How many pixels a frame may have while something moves, from what frames have taken so far.

const TARGET = 1 / 18; // seconds a frame: 15 a second, and some air
const FEWEST = 128 * 96;
const DRAWING_SHARE = 0.3; // of the target, at least, where posing alone takes longer
const CAUTION = 0.5; // how far one measurement moves the estimate

export class Pace {
  constructor() {
    this.secondsAPixel = null;
    this.rest = 0; // seconds a frame that pixels don't change: posing, the network, showing
  }

  /** A moving frame took `seconds` from asking to showing, `drawing` of them for its pixels. */
  measured(pixels, seconds, drawing) {
    const aPixel = drawing / pixels;
    if (this.secondsAPixel === null) {
      this.secondsAPixel = aPixel;
      this.rest = seconds - drawing;
      return;
    }
    this.secondsAPixel += CAUTION * (aPixel - this.secondsAPixel);
    this.rest += CAUTION * (seconds - drawing - this.rest);
  }

  /** A size of the proportions of `full`, and not above it. */
  size(full) {
    const all = full.width * full.height;
    const affordable = this.secondsAPixel === null ? all / 4 : this.#budget() / this.secondsAPixel;
    const pixels = Math.min(all, Math.max(affordable, FEWEST));
    const scale = steps(Math.sqrt(pixels / all));
    return { width: sized(full.width * scale), height: sized(full.height * scale) };
  }

  #budget() {
    return Math.max(TARGET - this.rest, DRAWING_SHARE * TARGET);
  }
}

/** Few different sizes, so that the image's sharpness doesn't flicker. */
const steps = (scale) => (scale >= 1 ? 1 : 2 ** (Math.floor(4 * Math.log2(scale)) / 4));

const sized = (pixels) => Math.max(1, Math.round(pixels));
