// The choice of what is shown: color, depth, motion or count.

const MOTION = "motion";

export class Views {
  /** `form` has a radio button for each view; `chosen(name)` is called when the user chooses one. */
  constructor(form, chosen) {
    this.buttons = form.elements.view;
    this.names = [...this.buttons].map((button) => button.value);
    this.motion = form.querySelector(`[value=${MOTION}]`);
    form.addEventListener("change", ({ target }) => chosen(target.value));
  }

  /** The view that is shown: the chosen one, or color if the scene doesn't have that. */
  get current() {
    return this.#offers(this.buttons.value) ? this.buttons.value : this.names[0];
  }

  /** Offer what a scene has, GET /scenes/{name}, and show a view. Returns whether the scene has it; color if not. */
  open({ motion }, wanted) {
    this.motion.setAttribute("aria-disabled", !motion);
    return this.show(wanted) || !this.show(this.names[0]);
  }

  /** Show a view. Returns whether it is offered. */
  show(name) {
    const isOffered = this.#offers(name);
    if (isOffered) this.buttons.value = name;
    return isOffered;
  }

  #offers(name) {
    return this.names.includes(name) && !(name === MOTION && this.motion.getAttribute("aria-disabled") === "true");
  }
}
