import { openEngine } from "/viewer/local/engine.js";

export async function make({ canvas, scene }) {
  const onError = (error) => console.error(error);
  const engine = await openEngine({ canvas, scene, runtime: "/packages/onnxruntime-web/dist/", onError });
  return { show: (camera, t) => engine.draw({ camera, t }), settled: () => engine.settled() };
}
