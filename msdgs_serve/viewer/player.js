// The scene's time: where it is, and how it runs.

const SECONDS_A_RUN = 4; // through all of the scene's time, at speed 1
const MOMENTS = 240; // that are shown while it runs; the service keeps what it has computed for them
export const SPEEDS = [0.25, 0.5, 1, 2];

export class Player {
  constructor() {
    this.range = [0, 1];
    this.place = 0; // 0 to 1 of the range
    this.playing = false;
    this.loop = true;
    this.speed = 1;
  }

  get t() {
    return this.at(this.place);
  }

  /** The scene's time at a place from 0 to 1, exactly the range's ends there. */
  at(place) {
    const [first, last] = this.range;
    if (place >= 1) return last;
    return Number(Math.min(Math.max(first + place * (last - first), first), last).toPrecision(6));
  }

  seek(place) {
    this.place = Math.min(Math.max(place, 0), 1);
  }

  seekTime(t) {
    const [first, last] = this.range;
    this.seek(last > first ? (t - first) / (last - first) : 0);
  }

  step(count) {
    this.seek(Math.round(this.place * MOMENTS + count) / MOMENTS);
  }

  start() {
    if (this.place >= 1) this.place = 0;
    this.playing = true;
    this.exact = this.place;
  }

  /** Go on by so many seconds. */
  advance(seconds) {
    this.exact += (seconds * this.speed) / SECONDS_A_RUN;
    if (this.exact >= 1 && !this.loop) {
      this.place = 1;
      this.playing = false;
      return;
    }
    this.exact %= 1;
    this.place = Math.floor(this.exact * MOMENTS) / MOMENTS;
  }
}
