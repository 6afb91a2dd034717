// The section with what can be taken away: a link, a command, files.

import { call, render, scenePath } from "./api.js";
import { frameBody, numbersBody } from "./request.js";
import { copy, curlCommand, linkTo, save } from "../share.js";

const TOLD_FOR = 2500; // milliseconds
const DIALOG_TITLES = { link: "The link to this view", curl: "The command for this frame" };

export class Exports {
  /** `host` has: state(), its scene null if there is none; size() of a full frame; guarded(action), which tells of errors. */
  constructor(host) {
    this.host = host;
    const find = (id) => document.getElementById(id);
    [this.told, this.dialog, this.title, this.text] = ["told", "text-dialog", "text-title", "text"].map(find);
    for (const button of document.querySelectorAll("[data-take]")) {
      button.addEventListener("click", () => host.state().scene && host.guarded(() => this.#take(button.dataset.take)));
    }
  }

  async #take(kind) {
    const state = this.host.state();
    const { name } = state.scene;
    const size = this.host.size();
    if (kind === "link") await this.#copy(kind, linkTo(state));
    else if (kind === "curl") await this.#copy(kind, curlCommand({ ...frameBody(state), ...size, format: "png" }));
    else if (kind === "onnx") await save(await call(`${scenePath(name)}/file`), `${name}.onnx`);
    else {
      const body = kind === "exr" ? numbersBody(state) : { ...frameBody(state), format: kind };
      await save(await render({ ...body, ...size }), `${name}-${state.player.t}.${kind}`);
    }
  }

  /** Copy a text, or show it selected if the browser forbids that. */
  async #copy(kind, text) {
    if (await copy(text)) {
      this.#tell("Copied.");
      return;
    }
    this.title.textContent = DIALOG_TITLES[kind];
    this.text.value = text;
    this.dialog.showModal();
    this.text.select();
  }

  #tell(text) {
    this.told.textContent = text;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => (this.told.textContent = ""), TOLD_FOR);
  }
}
