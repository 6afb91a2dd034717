// The slider of deformation layers: what moves the scene, one layer after the other.

export class Layers {
  /** `host` has changed(), after the slider was moved. */
  constructor(host) {
    const find = (id) => document.getElementById(id);
    [this.section, this.slider, this.text] = ["layers", "steps", "steps-text"].map(find);
    this.count = 0;
    this.steps = null; // how many are applied; null is all
    this.slider.addEventListener("input", () => {
      this.set(Number(this.slider.value));
      host.changed();
    });
  }

  /** A scene's number of layers; 0 where its plan doesn't run them. */
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
