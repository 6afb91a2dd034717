// The time slider and its buttons.

import { SPEEDS } from "./player.js";

export class Timeline {
  /** `host` has: changed(), called after the time was set; started(), called when playback starts. */
  constructor(player, host) {
    this.player = player;
    this.host = host;
    const find = (id) => document.getElementById(id);
    [this.play, this.slider, this.time, this.loop, this.speed] = ["play", "time", "time-text", "loop", "speed"].map(find);
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
    const text = `t ${player.t.toFixed(3)}`;
    this.slider.value = player.place;
    this.slider.setAttribute("aria-valuetext", text);
    this.time.textContent = text;
    this.play.dataset.playing = player.playing;
    this.play.setAttribute("aria-label", player.playing ? "Pause" : "Play");
    this.loop.setAttribute("aria-pressed", player.loop);
  }

  #set() {
    this.show();
    this.host.changed();
  }
}
