// The slider of deformation layers that are applied.

export class Layers {
  /** `host` has changed(), which is called after the slider was moved. */
  constructor(host) {
    const find = (id) => document.getElementById(id);
    [this.section, this.slider, this.text] = ["layers", "steps", "steps-text"].map(find);
    this.count = 0;
    this.steps = null; // number of applied layers; null for all
    this.slider.addEventListener("input", () => {
      this.set(Number(this.slider.value));
      host.changed();
    });
  }

  /** Set a scene's number of layers; 0 if its plan doesn't run layers. */
  open(count) {
    this.count = count;
    this.slider.max = count;
    this.section.hidden = count === 0;
    this.set(this.steps);
  }

  set(steps) {
    this.steps = steps === null || steps >= this.count ? null : Math.max(0, steps);
    const shown = this.steps ?? this.count;
    this.slider.value = shown;
    this.text.textContent = `${Number(shown.toFixed(2))} of ${this.count}`;
    this.slider.setAttribute("aria-valuetext", this.text.textContent);
  }
}
