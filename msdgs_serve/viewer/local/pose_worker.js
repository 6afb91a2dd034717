// A worker that poses a scene file by onnxruntime-web.

import { download } from "./download.js";
import { readSceneFile } from "./scene_file.js";

const POSED = ["means", "quats", "scales"];
const APPEARANCE = ["opacities", "sh"];
const WASM = [0x00, 0x61, 0x73, 0x6d]; // first bytes
const CHUNK = 2048; // Gaussians per call of a graph that runs layers on Gaussians

class Poser {
  /** Load onnxruntime-web and a scene. `runtime` has the addresses of onnxruntime-web's files. */
  static async open({ scene, runtime }) {
    const loaded = {};
    const tell = (part) => (bytes, total) => {
      loaded[part] = { bytes, total };
      const sums = Object.values(loaded);
      const sum = (key) => sums.reduce((all, each) => all + each[key], 0);
      self.postMessage({ kind: "progress", loaded: sum("bytes"), total: sums.every((x) => x.total) ? sum("total") : 0 });
    };
    const [ort, wasmBinary, bytes] = await Promise.all([
      import(runtime.module).catch(() => {
        throw new Error(`onnxruntime-web can’t be loaded: ${runtime.module} isn’t there.`);
      }),
      download(runtime.binary, "onnxruntime-web", tell("runtime")),
      download(scene, "The scene file", tell("scene")),
    ]);
    if (WASM.some((byte, k) => wasmBinary[k] !== byte)) {
      throw new Error(`onnxruntime-web can’t be used: ${runtime.binary.split("/").at(-1)} isn’t WebAssembly.`);
    }
    Object.assign(ort.env.wasm, { numThreads: 1, wasmBinary, wasmPaths: { mjs: runtime.glue } });
    const poser = new Poser(ort, readSceneFile(bytes));
    await poser.#start(bytes);
    return poser;
  }

  constructor(ort, { metadata, inputs, idCount, selectsLast }) {
    // called for chunks, of which values stay in the processor's cache, or once if it computes all in any case
    const chunk = inputs.has("ids") && inputs.has("steps") && !selectsLast ? CHUNK : Infinity;
    Object.assign(this, { ort, metadata, inputs, moving: idCount, chunk, ids: new Map() });
  }

  async #start(bytes) {
    const options = {
      executionProviders: ["wasm"],
      logSeverityLevel: 4,
      extra: { session: { disable_quant_qdq: "1" } }, // as the service: products in float32
    };
    this.session = await this.ort.InferenceSession.create(bytes, options).catch((error) => {
      throw new Error(`onnxruntime can’t open the scene file: ${error.message}`);
    });
    const { buffer } = this.ort.env.wasm.wasmBinary;
    structuredClone(buffer, { transfer: [buffer] }); // compiled now: lets go 14 MB that onnxruntime-web keeps
    const rows = Object.fromEntries(this.session.outputMetadata.map(({ name, shape }) => [name, shape[0]]));
    this.moving ??= rows.means;
    this.changing = APPEARANCE.filter((name) => `static_${name}` in rows);
    this.posed = [...POSED, ...this.changing];
    this.constant = [
      ...POSED.map((name) => `static_${name}`),
      ...APPEARANCE.map((name) => (this.changing.includes(name) ? `static_${name}` : name)),
    ];
  }

  get facts() {
    const { metadata, moving, changing } = this;
    return { metadata, moving, changing, steps: this.inputs.has("steps") ? metadata.layers.length : 0 };
  }

  /** The arrays that don't depend on time, by names without `static_`. */
  async constants() {
    const outputs = await this.#run(this.constant, this.metadata.time_range[0], undefined, 0, Math.min(1, this.moving));
    return Object.fromEntries(this.constant.map((name) => [name.replace("static_", ""), outputs[name].data]));
  }

  /** The arrays of the moving Gaussians at `t` after `steps` layers, all if undefined. */
  async pose(t, steps) {
    if (this.chunk >= this.moving) {
      const outputs = await this.#run(this.posed, t, steps, 0, this.moving);
      return Object.fromEntries(this.posed.map((name) => [name, outputs[name].data]));
    }
    const arrays = {};
    for (let first = 0; first < this.moving; first += this.chunk) {
      const outputs = await this.#run(this.posed, t, steps, first, Math.min(this.chunk, this.moving - first));
      for (const name of this.posed) {
        const { data, dims } = outputs[name];
        const row = data.length / dims[0];
        arrays[name] ??= new Float32Array(this.moving * row);
        arrays[name].set(data, first * row);
      }
    }
    return arrays;
  }

  /** Run the graph for `count` ids from `first`. */
  #run(names, t, steps, first, count) {
    const { Tensor } = this.ort;
    const feeds = { t: new Tensor("float32", Float32Array.of(t)) };
    if (this.inputs.has("ids")) feeds.ids = this.#ids(first, count);
    if (this.inputs.has("steps")) {
      feeds.steps = new Tensor("float32", Float32Array.of(steps ?? this.metadata.layers.length));
    }
    return this.session.run(feeds, names);
  }

  #ids(first, count) {
    const key = `${first} ${count}`;
    if (!this.ids.has(key)) {
      const ids = BigInt64Array.from({ length: count }, (_, k) => BigInt(first + k));
      this.ids.set(key, new this.ort.Tensor("int64", ids));
    }
    return this.ids.get(key);
  }
}

let poser = null;

const answers = {
  async open(message) {
    poser = await Poser.open(message);
    return { kind: "opened", ...poser.facts, arrays: await poser.constants() };
  },
  async pose({ t, steps, slot }) {
    const start = performance.now();
    const arrays = await poser.pose(t, steps);
    return { kind: "pose", t, steps, slot, arrays, milliseconds: performance.now() - start };
  },
};

async function answer(message) {
  try {
    const made = await answers[message.kind](message);
    self.postMessage(made, Object.values(made.arrays ?? {}).map((array) => array.buffer));
  } catch (error) {
    self.postMessage({ kind: "failed", message: error.message });
  }
}

let last = Promise.resolve();
self.onmessage = ({ data }) => (last = last.then(() => answer(data))); // one at a time
