// Mouse, touch and keyboard: camera movements and commands.

const ORBIT_SPEED = 200; // degrees per image height of dragging
const LOOK_SPEED = 50;
const WHEEL_SPEED = 0.0012; // change of log distance per pixel of scrolling
const WHEEL_PIXELS = [1, 16, 400]; // by the event's deltaMode: pixels, lines, pages
const FLY_SPEED = 0.5; // scene distances per second
const FAST = 4;
const KEY_TURN = 5; // degrees
const KEY_ZOOM = 1.1;

const FLYING = {
  KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0],
}; // prettier-ignore
const TURNING = {
  ArrowLeft: [KEY_TURN, 0], ArrowRight: [-KEY_TURN, 0], ArrowUp: [0, KEY_TURN], ArrowDown: [0, -KEY_TURN],
}; // prettier-ignore

export class Controls {
  /** `host` has: camera(), which may return null; moved(); command(key), true if it handles the key. */
  constructor(canvas, host) {
    this.canvas = canvas;
    this.host = host;
    this.pointers = new Map();
    this.flying = new Set();
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    document.addEventListener("keydown", (event) => this.#keyDown(event));
    document.addEventListener("keyup", (event) => this.flying.delete(event.code));
    window.addEventListener("blur", () => this.flying.clear());
  }

  /** Fly for some seconds. Return whether any key is held. */
  advance(seconds, isFast) {
    const camera = this.host.camera();
    if (!camera || this.flying.size === 0) return false;
    const step = seconds * FLY_SPEED * (isFast ? FAST : 1);
    for (const code of this.flying) camera.fly(...FLYING[code].map((x) => x * step));
    this.host.moved();
    return true;
  }

  #down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.focus({ preventScroll: true });
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button });
    event.preventDefault();
  }

  #move(event) {
    const pointer = this.pointers.get(event.pointerId);
    const camera = this.host.camera();
    if (!pointer || !camera) return;
    const height = this.canvas.clientHeight;
    const before = this.#spread();
    const [x, y] = [(event.clientX - pointer.x) / height, (event.clientY - pointer.y) / height];
    [pointer.x, pointer.y] = [event.clientX, event.clientY];
    if (this.pointers.size > 1) {
      const after = this.#spread();
      if (before > 0 && after > 0) camera.zoom(before / after);
      camera.pan(-x / this.pointers.size, y / this.pointers.size);
    } else if (event.shiftKey || pointer.button !== 0) camera.pan(-x, y);
    else if (event.altKey || event.ctrlKey) camera.look(-x * LOOK_SPEED, y * LOOK_SPEED);
    else camera.orbit(-x * ORBIT_SPEED, y * ORBIT_SPEED);
    this.host.moved();
  }

  /** Distance between two fingers, in pixels. */
  #spread() {
    const [a, b] = [...this.pointers.values()];
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  }

  #wheel(event) {
    const camera = this.host.camera();
    if (!camera) return;
    event.preventDefault();
    const pixels = event.deltaY * WHEEL_PIXELS[event.deltaMode] * (event.ctrlKey ? 8 : 1); // pinching a trackpad
    camera.zoom(Math.exp(Math.max(-400, Math.min(400, pixels)) * WHEEL_SPEED));
    this.host.moved();
  }

  #keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || isTyping(event.target)) return;
    const camera = this.host.camera();
    if (!camera) return;
    if (event.code in FLYING) {
      this.flying.add(event.code);
      this.host.moved();
    } else if (event.key in TURNING && isFree(event.target, this.canvas)) camera.orbit(...TURNING[event.key]);
    else if (event.key === "+" || event.key === "=") camera.zoom(1 / KEY_ZOOM);
    else if (event.key === "-") camera.zoom(KEY_ZOOM);
    else {
      if (event.key === " " && event.target.closest("button, a")) return;
      if (this.host.command(event.key)) event.preventDefault();
      return;
    }
    event.preventDefault();
    this.host.moved();
  }
}

const isTyping = (target) =>
  target.closest("select, textarea, dialog, input:not([type=range], [type=radio])") !== null;

/** Whether no other element handles arrows. */
const isFree = (target, canvas) => target === canvas || target === document.body;
