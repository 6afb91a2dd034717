// Playback of the scene's time.

import { short } from "./camera.js";

const RUN_SECONDS = 4; // for the whole time range at speed 1, if the scene doesn't say how long it lasts
const STEPS_PER_SECOND = 60; // distinct times during playback at speed 1, whose poses the service caches
const MIN_STEPS = 240; // enough for short scenes at the lowest speed
export const SPEEDS = [0.25, 0.5, 1, 2];

export class Player {
  constructor() {
    this.range = [0, 1];
    this.duration = null; // of the range, seconds
    this.changes = true; // whether the scene depends on time
    this.place = 0; // fraction of the time range
    this.exact = 0; // the same, not rounded to a step
    this.playing = false;
    this.loop = true;
    this.speed = 1;
    this.isSmooth = false; // whether playback shows any time, not only some
  }

  /** Take over times of a scene, GET /scenes/{name}. */
  open({ time_range: range, duration, changes }) {
    Object.assign(this, { range, duration, changes });
    this.playing &&= changes;
  }

  get t() {
    return this.at(this.place);
  }

  /** Seconds of a whole run at speed 1. */
  get seconds() {
    return this.duration ?? RUN_SECONDS;
  }

  /** Number of steps of the whole time range. */
  get steps() {
    return Math.max(MIN_STEPS, Math.round(STEPS_PER_SECOND * this.seconds));
  }

  /** Return the scene's time at a fraction of its range, exact at both ends. */
  at(place) {
    const [first, last] = this.range;
    if (place <= 0) return first;
    if (place >= 1) return last;
    return Math.min(Math.max(short(first + place * (last - first), last - first), first), last);
  }

  seek(place) {
    this.place = this.exact = Math.min(Math.max(place, 0), 1);
  }

  seekTime(t) {
    const [first, last] = this.range;
    this.seek(last > first ? (t - first) / (last - first) : 0);
  }

  step(count) {
    this.seek(Math.round(this.place * this.steps + count) / this.steps);
  }

  /** Play, if anything changes with time. */
  start() {
    if (this.place >= 1) this.seek(0);
    this.playing = this.changes;
  }

  /** Advance playback by some seconds. */
  advance(seconds) {
    this.exact += (seconds * this.speed) / this.seconds;
    if (this.exact >= 1 && !this.loop) {
      this.seek(1);
      this.playing = false;
      return;
    }
    this.exact %= 1;
    this.place = this.isSmooth ? this.exact : Math.floor(this.exact * this.steps) / this.steps;
  }
}
