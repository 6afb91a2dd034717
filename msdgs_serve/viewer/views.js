// The choice of what is shown: color, depth, motion or count.

const MOTION = "motion";

export class Views {
  /** `form` has a radio button for each view; `chosen(name)` is called when the user chooses one. */
  constructor(form, chosen) {
    this.buttons = form.elements.view;
    this.names = [...this.buttons].map((button) => button.value);
    this.drawn = []; // by the source of frames
    this.moves = false; // whether the scene has motion
    form.addEventListener("change", ({ target }) => chosen(target.value));
  }

  /** The view that is shown: the chosen one, or color if that isn't offered. */
  get current() {
    return this.#lack(this.buttons.value) ? this.names[0] : this.buttons.value;
  }

  /** Offer those of `drawn` that a scene has, GET /scenes/{name}, and show a view, or color. Returns what `show` does. */
  open({ motion }, drawn, wanted) {
    [this.drawn, this.moves] = [drawn, motion];
    for (const button of this.buttons) button.setAttribute("aria-disabled", this.#lack(button.value) !== "");
    const lack = this.show(wanted);
    if (lack) this.show(this.names[0]);
    return lack;
  }

  /** Show a view, if it is offered. Returns why it isn't, in words; an empty text if it is. */
  show(name) {
    const lack = this.#lack(name);
    if (!lack) this.buttons.value = name;
    return lack;
  }

  #lack(name) {
    if (!this.names.includes(name)) return "The link asks for a view that this page doesn’t have: this is the color.";
    if (!this.drawn.includes(name)) return "Browsers don’t draw this view, only msdgs-serve does: this is the color.";
    if (name !== MOTION || this.moves) return "";
    return "Nothing moves in this scene that could be shown as motion: this is its color.";
  }
}
