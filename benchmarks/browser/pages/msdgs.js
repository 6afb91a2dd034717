import { openEngine } from "/viewer/local/engine.js";

const DIST = "/runtime/dist/";
const RUNTIME = {
  module: `${DIST}ort.wasm.min.mjs`,
  glue: `${DIST}ort-wasm-simd-threaded.mjs`,
  binary: `${DIST}ort-wasm-simd-threaded.wasm`,
};

export async function make({ canvas, scene }) {
  const onError = (error) => console.error(error);
  const engine = await openEngine({ canvas, scene, runtime: RUNTIME, onError });
  return { show: (camera, t) => engine.draw({ camera, t }), settled: () => engine.settled() };
}
