// A scene on the page: its state, and the connections between camera, time, panels and the source of its pixels.

import { Camera } from "./camera.js";
import { Controls } from "./controls.js";
import { showFacts } from "./facts.js";
import { Layers } from "./layers.js";
import { Player } from "./player.js";
import { toHash } from "./share.js";
import { Stage } from "./stage.js";
import { Timeline } from "./timeline.js";
import { Views } from "./views.js";

const find = (id) => document.getElementById(id);

/**
 * @typedef {object} Source  of pixels: service/frames.js, local/source.js
 * @property {string} label  who draws, for the status line
 * @property {string[]} views  what it can show, see views.js
 * @property {boolean} isSmooth  whether playback may show any time, not only some, whose poses are cached
 * @property {boolean} paused  whether it shows nothing new, for now
 * @property {boolean} refused  whether this view can't be shown
 * @property {boolean} isIdle  whether it has shown what was asked for
 * @property {boolean} [isLoading]  whether it is opening a scene
 * @property {(scene) => Promise<void>} open  show the viewer's scene, which may have another file now
 * @property {(how?: {cut: boolean}) => void} change  show the viewer's view; `cut`: frames on their way are useless
 * @property {() => void} stop
 * @property {() => {width: number, height: number}} fullSize  of a frame in full quality
 */

export class Viewer {
  /** `host` has shown(facts), which is called after each frame. */
  constructor(host) {
    this.host = host;
    this.scene = null; // as GET /scenes/{name} describes it
    this.camera = null;
    this.source = null;
    this.player = new Player();
    this.layers = new Layers({ changed: () => this.changed() });
    this.views = new Views(find("view"), (view) => this.setView(view));
    this.stage = new Stage(find("image"), find("status"));
    this.timeline = new Timeline(this.player, { changed: () => this.changed(), started: () => this.#run() });
    this.controls = new Controls(find("image"), {
      camera: () => this.camera,
      moved: () => this.moved(),
      command: (key) => this.#command(key),
    });
    this.isFast = false;
    this.running = 0;
    this.#listen();
  }

  get view() {
    return this.views.current;
  }

  /** Draw with a source from now on. `open` or the next change shows its first frame. */
  use(source) {
    this.source?.stop();
    this.source = source;
    this.player.isSmooth = source.isSmooth;
  }

  /** Show a scene, or the same one from a file that has changed, and what an address asks for. */
  open(scene, look = {}) {
    const isAnother = this.scene?.name !== scene.name;
    this.scene = scene;
    document.body.classList.remove("empty");
    this.player.open(scene);
    this.timeline.open();
    this.stage.open(scene, isAnother);
    if (isAnother) {
      this.camera = new Camera(scene.view);
      this.camera.aspect = this.stage.aspect();
      this.player.seek(0);
      this.layers.set(null);
    } else this.camera.setView(scene.view);
    this.layers.open(scene.steps);
    const { sceneCamera } = this.camera;
    this.camera.sceneCamera = null; // unless the file still has it, maybe with another pose
    this.#apply({ sceneCamera });
    this.#apply(look);
    this.offerViews(look.view ?? this.view);
    this.#describe();
    return this.source.open(scene);
  }

  /** Offer what both the scene and the source have, and show `wanted`, or say that it isn't there. */
  offerViews(wanted = this.view) {
    notice(this.views.open(this.scene, this.source.views, wanted));
  }

  /** Show no scene. */
  close() {
    this.scene = this.camera = null;
    this.player.playing = false;
    this.source.stop();
    document.body.classList.add("empty");
    notice("");
  }

  /** The view has changed. */
  changed() {
    if (this.camera) this.source.change();
  }

  /** The camera has moved. */
  moved() {
    find("camera").value = this.camera.sceneCamera ?? "";
    this.changed();
    if (this.controls.flying.size > 0) this.#run();
  }

  setView(view) {
    const lack = this.views.show(view);
    notice(lack);
    if (!lack) this.source.change({ cut: true });
  }

  /** Stop at the shown time. */
  pause() {
    if (this.player.playing) this.timeline.toggle();
  }

  /** Whether the view goes on changing by itself. */
  get isMoving() {
    return this.player.playing || this.controls.flying.size > 0;
  }

  /** A source has shown a frame. */
  shown(facts) {
    this.stage.tell({ ...facts, label: this.source.label });
    this.host.shown(facts);
    if (facts.full && !this.isMoving) history.replaceState(null, "", toHash(this));
  }

  #apply({ t = null, steps, at = null, lens, sceneCamera = null }) {
    if (t !== null) this.player.seekTime(t);
    if (steps !== undefined) this.layers.set(steps); // null in an address without them: all
    if (at) {
      this.camera.reset();
      this.camera.setLens(lens);
      [this.camera.azimuth, this.camera.elevation, this.camera.distance] = at;
      this.camera.target = at.slice(3);
    }
    if (sceneCamera in this.scene.cameras) this.camera.take(this.scene.cameras[sceneCamera], sceneCamera);
  }

  #describe() {
    const { scene } = this;
    showFacts(find("facts"), scene);
    const options = scene.cameras.map((camera, i) => new Option(camera.name, i));
    find("camera").replaceChildren(new Option("Free view", ""), ...options);
    find("camera").hidden = scene.cameras.length === 0;
    find("camera").value = this.camera.sceneCamera ?? "";
    this.timeline.show();
  }

  /** Advance playback and flight with animation frames, while either is active and the page is visible. */
  #run() {
    if (this.running || document.hidden) return;
    let before = performance.now();
    const tick = (now) => {
      const seconds = Math.min(Math.max(now - before, 0) / 1000, 0.5);
      before = now;
      if (this.player.playing && !this.source.paused) {
        this.player.advance(seconds);
        this.timeline.show();
        this.changed();
      }
      const isFlying = this.controls.advance(seconds, this.isFast);
      const goesOn = (this.player.playing || isFlying) && !document.hidden;
      this.running = goesOn ? requestAnimationFrame(tick) : 0;
    };
    this.running = requestAnimationFrame(tick);
  }

  #command(key) {
    const view = this.views.names[Number(key) - 1];
    const { changes } = this.player;
    const letter = key.toLowerCase(); // with Caps Lock, too
    if (view) this.setView(view);
    else if (key === " " && changes) this.timeline.toggle();
    else if (key === "," && changes) this.timeline.step(-1);
    else if (key === "." && changes) this.timeline.step(1);
    else if (letter === "r") this.#reset();
    else if (letter === "f") this.#fillScreen();
    else if (key === "?") find("help").showModal();
    else return false;
    return true;
  }

  #reset() {
    if (!this.camera) return;
    this.camera.reset();
    this.moved();
  }

  #fillScreen() {
    if (!document.fullscreenEnabled) return;
    if (document.fullscreenElement) document.exitFullscreen();
    else document.querySelector("main").requestFullscreen();
  }

  #listen() {
    find("reset").addEventListener("click", () => this.#reset());
    find("full-screen").hidden = !document.fullscreenEnabled;
    find("full-screen").addEventListener("click", () => this.#fillScreen());
    find("camera").addEventListener("change", ({ target }) => {
      if (target.value === "") return;
      const index = Number(target.value);
      this.camera.take(this.scene.cameras[index], index);
      this.moved();
    });
    for (const button of document.querySelectorAll("[data-opens]")) {
      button.addEventListener("click", () => find(button.dataset.opens).showModal());
    }
    for (const event of ["keydown", "keyup"]) document.addEventListener(event, ({ shiftKey }) => (this.isFast = shiftKey));
    document.addEventListener("visibilitychange", () => this.isMoving && this.#run());
    this.stage.onResize(() => {
      if (this.camera) this.camera.aspect = this.stage.aspect();
      if (!this.source?.refused) this.changed(); // a message that appears resizes the image too
    });
  }
}

/** Say what isn't shown of what was asked for; nothing if that is empty. */
function notice(text) {
  find("notice").textContent = text;
}
