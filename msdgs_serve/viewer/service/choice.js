// The choice of who draws, which the page offers if the service has the files of onnxruntime-web.

import { LocalSource } from "../local/source.js";
import { call, received, scenePath } from "./api.js";

export class Choice {
  /** `frames` draws until the user chooses otherwise; `failed(error)` tells of errors. */
  constructor(viewer, frames, failed) {
    const { runtime } = document.documentElement.dataset;
    Object.assign(this, { viewer, frames, failed });
    this.form = document.getElementById("source");
    this.form.hidden = runtime === undefined;
    this.local = new LocalSource(viewer, { runtime, file });
    this.form.addEventListener("change", ({ target }) => this.#choose(target.value));
    viewer.use(frames);
  }

  /** Open a scene by the chosen source, or by the service if this browser can't draw it. */
  async guarded(action) {
    try {
      await action();
    } catch (error) {
      if (this.viewer.source === this.frames) throw error;
      this.failed(error);
      this.form.elements.source.value = "service";
      await this.#choose("service");
    }
  }

  async #choose(name) {
    const { viewer } = this;
    viewer.use(name === "local" ? this.local : this.frames);
    if (!viewer.scene) return;
    viewer.offerViews();
    await this.guarded(() => viewer.source.open(viewer.scene));
  }
}

/** The bytes of a scene's file. */
async function file({ name }) {
  return received((await call(`${scenePath(name)}/file`)).arrayBuffer());
}
