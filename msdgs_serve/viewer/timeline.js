// The time slider and its buttons, for scenes that change with time.

import { inRange, plain } from "./numbers.js";
import { SPEEDS } from "./player.js";

export class Timeline {
  /** `host` has: changed(), called after the time was set; started(), called when playback starts. */
  constructor(player, host) {
    this.player = player;
    this.host = host;
    const find = (id) => document.getElementById(id);
    this.parts = document.querySelectorAll(".of-time"); // also of the help
    const ids = ["play", "time", "time-text", "loop", "speed"];
    [this.play, this.slider, this.time, this.loop, this.speed] = ids.map(find);
    this.play.addEventListener("click", () => this.toggle());
    this.slider.addEventListener("input", () => {
      player.playing = false;
      player.seek(Number(this.slider.value));
      this.#set();
    });
    this.loop.addEventListener("click", () => {
      player.loop = !player.loop;
      this.show();
    });
    this.speed.replaceChildren(...SPEEDS.map((speed) => new Option(`${speed}×`, speed, speed === 1, speed === 1)));
    this.speed.addEventListener("change", () => (player.speed = Number(this.speed.value)));
  }

  /** Follow the player to another scene. */
  open() {
    for (const part of this.parts) part.hidden = !this.player.changes;
    this.speed.title = `At 1× a run takes ${plain(this.player.seconds)} seconds`;
    this.show();
  }

  toggle() {
    if (this.player.playing) this.player.playing = false;
    else this.player.start();
    if (this.player.playing) this.host.started();
    this.#set();
  }

  step(count) {
    this.player.playing = false;
    this.player.step(count);
    this.#set();
  }

  show() {
    const { player } = this;
    const text = this.#text();
    this.slider.value = player.place;
    this.slider.setAttribute("aria-valuetext", text);
    this.time.textContent = text;
    this.play.dataset.playing = player.playing;
    this.play.setAttribute("aria-label", player.playing ? "Pause" : "Play");
    this.loop.setAttribute("aria-pressed", player.loop);
  }

  /** The time with as many digits as tell a thousandth of the range. */
  #text() {
    const [first, last] = this.player.range;
    return `t ${inRange(this.player.t, last - first)}`;
  }

  #set() {
    this.show();
    this.host.changed();
  }
}
