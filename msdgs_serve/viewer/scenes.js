// The list of scenes with thumbnails.

import { call, getJson } from "./api.js";

const THUMBNAIL = { width: 96, height: 72 };

export class SceneList {
  /** `host` has: open(name); isIdle(), whether a thumbnail may be requested now. */
  constructor(list, host) {
    this.list = list;
    this.host = host;
    this.items = new Map();
    this.waiting = new Set();
    this.failed = new Set();
    this.isDrawing = false;
    this.observer = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) {
        if (isIntersecting) this.waiting.add(target.dataset.scene);
        else this.waiting.delete(target.dataset.scene);
      }
    });
    setInterval(() => this.#drawOne(), 200);
  }

  get names() {
    return [...this.items.keys()];
  }

  /** Update the list from the service. Throws the errors of `call`. */
  async refresh() {
    const { scenes } = await getJson("scenes");
    const names = new Set(scenes.map((scene) => scene.name));
    for (const [name, item] of this.items) {
      if (!names.has(name)) this.#remove(name, item);
    }
    for (const [i, scene] of scenes.entries()) {
      const item = this.items.get(scene.name) ?? this.#add(scene.name);
      if (this.list.children[i] !== item) this.list.insertBefore(item, this.list.children[i]); // moving drops the focus
      if (!scene.problem && this.failed.delete(scene.name)) this.waiting.add(scene.name);
      item.classList.toggle("broken", scene.problem);
      item.querySelector(".note").textContent = scene.problem ? "file is broken" : "";
      item.title = scene.reason ?? "";
    }
  }

  /** Mark the current scene. */
  mark(name) {
    for (const [each, item] of this.items) {
      const button = item.querySelector("button");
      if (each === name) button.setAttribute("aria-current", "true");
      else button.removeAttribute("aria-current");
    }
  }

  /** Render a scene's thumbnail again. */
  renew(name) {
    if (this.items.has(name)) this.waiting.add(name);
  }

  #add(name) {
    const item = document.getElementById("scene-item").content.firstElementChild.cloneNode(true);
    item.dataset.scene = name;
    item.querySelector(".name").textContent = name;
    item.querySelector("button").addEventListener("click", () => this.host.open(name));
    const image = item.querySelector("canvas");
    [image.width, image.height] = [2 * THUMBNAIL.width, 2 * THUMBNAIL.height];
    this.items.set(name, item);
    this.observer.observe(item);
    return item;
  }

  #remove(name, item) {
    this.observer.unobserve(item);
    this.waiting.delete(name);
    this.items.delete(name);
    item.remove();
  }

  async #drawOne() {
    const [name] = this.waiting;
    if (name === undefined || this.isDrawing || document.hidden || !this.host.isIdle()) return;
    this.isDrawing = true;
    this.waiting.delete(name);
    try {
      const image = this.items.get(name).querySelector("canvas");
      const query = new URLSearchParams({ scene: name, width: image.width, height: image.height, format: "jpeg" });
      const bitmap = await createImageBitmap(await (await call(`render?${query}`)).blob());
      image.getContext("2d").drawImage(bitmap, 0, 0);
      this.observer.unobserve(this.items.get(name) ?? image);
    } catch {
      this.failed.add(name); // the request for the frame itself reports the error
    } finally {
      this.isDrawing = false;
    }
  }
}
