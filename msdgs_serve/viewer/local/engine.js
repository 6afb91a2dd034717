// Draws a scene file with WebGL2: poses by onnxruntime-web in a worker, which also sorts.

/**
 * @param {object} options
 * @param {HTMLCanvasElement} options.canvas
 * @param {string | Blob | ArrayBuffer} options.scene  the scene file, or its address
 * @param {string} options.runtime  address of the folder with onnxruntime-web's files
 * @param {(bytes: {loaded: number, total: number}) => void} [options.onProgress]
 * @param {(error: Error) => void} [options.onError]
 */
export async function openEngine({ canvas, scene, runtime, onProgress, onError }) {
  throw new Error("Drawing in the browser is not available.");
}
