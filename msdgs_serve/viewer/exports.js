// The section with what can be taken away: a link, a command, files.

import { unsay } from "./banner.js";
import { copy, save } from "./share.js";

const TOLD_FOR = 2500; // milliseconds
const DIALOG_TITLES = { link: "The link to this view", curl: "The command for this frame" };

export class Exports {
  /**
   * `takes` has a function for each button, by its kind: it returns a text to copy, or { contents, name } of a file to
   * save; a promise of either, too. `guarded(action)` tells of errors.
   */
  constructor(takes, guarded) {
    const find = (id) => document.getElementById(id);
    [this.told, this.dialog, this.title, this.text] = ["told", "text-dialog", "text-title", "text"].map(find);
    for (const button of document.querySelectorAll("[data-take]")) {
      const kind = button.dataset.take;
      button.addEventListener("click", () => guarded(() => this.#take(kind, takes[kind])));
    }
  }

  async #take(kind, take) {
    unsay(this.problem);
    try {
      const taken = await take();
      await (typeof taken === "string" ? this.#copy(kind, taken) : save(taken.contents, taken.name));
    } catch (error) {
      this.problem = error.message; // which `guarded` tells
      throw error;
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
