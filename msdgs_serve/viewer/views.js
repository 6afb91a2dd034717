// The choice of what is shown: color, depth, motion or count.

const MOTION = "motion";

export class Views {
  /** `form` has a radio button for each view; `chosen(name)` is called when the user chooses one. */
  constructor(form, chosen) {
    this.buttons = form.elements.view;
    this.names = [...this.buttons].map((button) => button.value);
    this.current = this.names[0];
    this.drawn = []; // by the source of frames
    this.moves = false; // whether the scene has motion
    form.addEventListener("change", ({ target }) => chosen(target.value));
  }

  /** Offer those of `drawn` that a scene has, GET /scenes/{name}, and show a view, or color. Returns as `show` does. */
  open({ motion }, drawn, wanted) {
    [this.drawn, this.moves] = [drawn, motion];
    for (const button of this.buttons) button.setAttribute("aria-disabled", this.#lack(button.value) !== "");
    const lack = this.#lack(wanted);
    this.show(lack ? this.names[0] : wanted);
    return lack && `${lack}: this is the color.`;
  }

  /** Show a view, or go on with the current one if it isn't offered. Returns why it isn't, in words, else an empty text. */
  show(name) {
    const lack = this.#lack(name);
    if (!lack) this.current = name;
    this.buttons.value = this.current; // the browser has checked the chosen one
    return lack && `${lack}.`;
  }

  #lack(name) {
    if (!this.names.includes(name)) return "The link asks for a view that this page doesn’t have";
    if (!this.drawn.includes(name)) return "Browsers don’t draw this view, only msdgs-serve does";
    if (name !== MOTION || this.moves) return "";
    return "Nothing moves in this scene that could be shown as motion";
  }
}
