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
      item.title = scene.reason ?? scene.name;
    }
  }

  /** Return the name of the listed scene that a link means, if any; composed and decomposed accents are the same. */
  find(name) {
    return this.items.has(name) ? name : this.names.find((each) => each.normalize() === name.normalize());
  }

  /** Mark the current scene, and scroll to it if it is another one. */
  mark(name) {
    for (const [each, item] of this.items) {
      const button = item.querySelector("button");
      if (each !== name) button.removeAttribute("aria-current");
      else if (!button.hasAttribute("aria-current")) {
        button.setAttribute("aria-current", "true");
        this.#scrollTo(item);
      }
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

  /** Bring an item to the middle of the list, if part of it is out of sight; the page itself doesn't scroll. */
  #scrollTo(item) {
    const [seen, box] = [this.list, item].map((each) => each.getBoundingClientRect());
    const isInside = box.top >= seen.top && box.bottom <= seen.bottom && box.left >= seen.left && box.right <= seen.right;
    if (isInside) return;
    const [left, top] = [box.left + box.right - seen.left - seen.right, box.top + box.bottom - seen.top - seen.bottom];
    this.list.scrollBy(left / 2, top / 2);
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
