// Which poses are shown at a time, and which one is asked for next.

const SLOTS = 3; // poses that are kept: two that are shown, and the next
const AHEAD = 2; // times until a pose is there: the next one is asked for then, and there before this one is passed
const SMOOTHING = 0.3; // weight of the newest measurement
const LEAP = 4; // times the way ahead: a jump in time
const BREAK = 1; // seconds without a frame, as of a hidden page: no measure of its display

export class Poses {
  /** `ask({ t, steps, slot })` asks for a pose, which is given to `received`. */
  constructor({ interpolates, range }, ask) {
    Object.assign(this, { interpolates, range, ask });
    this.seconds = 0; // that a pose takes
    this.interval = 0; // seconds between frames of playback
    this.kept = []; // { t, steps, slot } by time; the first is shown
    this.isAsking = false;
    this.last = null; // { t, now } of playback
    this.rate = 0; // of playback, scene time per second
  }

  received(pose, milliseconds) {
    this.isAsking = false;
    const seconds = milliseconds / 1000;
    this.seconds = Math.max(smoothed(this.seconds, seconds), seconds); // a late pose shows
    const earlier = this.kept.filter((each) => each.t < pose.t && each.steps === pose.steps);
    this.kept = this.interpolates ? [...earlier, pose] : [pose];
  }

  failed() {
    this.isAsking = false;
  }

  /**
   * Return what is shown at a time, { first, second, share, isExact }: two poses, the share of the way between them, and
   * whether that is the pose at `t`; null if there is none yet. `now` is in seconds. While time goes on the poses ahead
   * of it are asked for, else the one at `t`.
   */
  at({ t, steps, playing }, now) {
    while (this.kept.length > 1 && this.kept[1].t <= t) this.kept.shift();
    if (playing && this.interpolates) this.#askAhead(t, steps, now);
    else {
      this.last = null;
      this.kept = this.kept.slice(0, 2);
      const [first] = this.kept;
      if (!first || first.t !== t || first.steps !== steps) this.#ask(t, steps);
    }
    if (!this.kept.length) return null;
    const [first, second = first] = this.kept;
    const isBetween = first.t < t && t < second.t;
    const share = isBetween ? (t - first.t) / (second.t - first.t) : 0;
    return { first, second: isBetween ? second : first, share, isExact: first.t === t && first.steps === steps };
  }

  #askAhead(t, steps, now) {
    this.#measureRate(t, now);
    const ahead = AHEAD * (this.seconds + this.interval) * this.rate;
    const [first, latest] = [this.kept[0], this.kept.at(-1)];
    const next = Math.min(t + ahead, this.range[1]);
    const isElsewhere =
      !first || first.steps !== steps || t < first.t - LEAP * ahead || t > latest.t + LEAP * ahead;
    if (isElsewhere) this.kept = this.kept.slice(0, 1);
    if (isElsewhere || latest.t < next) this.#ask(next, steps);
  }

  #ask(t, steps) {
    if (this.isAsking || this.kept.length === SLOTS) return;
    const used = this.kept.map(({ slot }) => slot);
    const slot = [...Array(SLOTS).keys()].find((each) => !used.includes(each));
    this.isAsking = true;
    this.ask({ t, steps, slot });
  }

  #measureRate(t, now) {
    if (t === this.last?.t) return;
    const interval = now - this.last?.now;
    if (t > this.last?.t && interval > 0 && interval < BREAK) {
      this.interval = smoothed(this.interval, interval);
      this.rate = smoothed(this.rate, (t - this.last.t) / interval);
    }
    this.last = { t, now };
  }
}

const smoothed = (mean, value) => (mean ? mean + SMOOTHING * (value - mean) : value);
