// The choice of who draws, which the page offers if the service has the files of onnxruntime-web.

import { call, received, scenePath } from "./api.js";

export class Choice {
  /** `frames` draws until the user chooses otherwise; `failed(error)` tells of errors. */
  constructor(viewer, frames, failed) {
    Object.assign(this, { viewer, frames, failed, local: null });
    this.runtime = document.documentElement.dataset.runtime;
    this.form = document.getElementById("source");
    this.form.hidden = this.runtime === undefined;
    this.form.addEventListener("change", ({ target }) => this.guarded(() => this.#choose(target.value)));
    viewer.use(frames);
  }

  /** Do what needs the chosen source; if this browser can't, say why, and let the service draw. */
  async guarded(action) {
    try {
      await action();
    } catch (error) {
      if (this.chosen === "service") throw error;
      this.form.elements.source.value = "service";
      await this.#choose("service");
      this.failed(error);
    }
  }

  get chosen() {
    return this.form.elements.source.value;
  }

  async #choose(name) {
    const { viewer } = this;
    const source = name === "local" ? await this.#local() : this.frames;
    if (name !== this.chosen) return; // meanwhile the user has chosen the other one
    viewer.use(source);
    if (!viewer.scene) return;
    viewer.offerViews();
    await viewer.source.open(viewer.scene);
  }

  async #local() {
    const { LocalSource } = await import("../local/source.js");
    return (this.local ??= new LocalSource(this.viewer, { runtime: this.runtime, file }));
  }
}

/** The bytes of a scene's file. */
async function file({ name }) {
  return received((await call(`${scenePath(name)}/file`)).arrayBuffer());
}
