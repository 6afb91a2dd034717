// Drives a renderer: `open` loads a scene, `still` returns the pixels of one view, `moving` measures frames of a camera
// that turns. A renderer has show(camera), which draws in one of the next animation frames, and settled().

let renderer, canvas;
let [worked, waited] = [0, 0]; // milliseconds of animation frames without waiting for the picture, and of waiting

const original = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (callback) =>
  original((now) => {
    const [start, before] = [performance.now(), waited];
    callback(now);
    worked += performance.now() - start - (waited - before);
  });

export async function open(name, options) {
  canvas = document.querySelector("canvas");
  [canvas.width, canvas.height] = [options.width, options.height];
  const { make } = await import(`./${name}.js`);
  renderer = await make({ canvas, ...options });
}

/** Wait until everything drawn so far is in the canvas. */
function finish() {
  const start = performance.now();
  const gl = canvas.getContext("webgl2");
  const [target, buffer] = [gl.getParameter(gl.FRAMEBUFFER_BINDING), gl.getParameter(gl.PIXEL_PACK_BUFFER_BINDING)];
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  gl.bindFramebuffer(gl.FRAMEBUFFER, target);
  gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
  waited += performance.now() - start;
}

const nextFrame = () => new Promise((resolve) => original(resolve));

/** Draw a view, until the canvas shows it. */
export async function still(camera, t) {
  renderer.show(camera, t);
  await renderer.settled();
  await nextFrame();
}

/** Milliseconds per frame, and of them on the main thread, while the camera goes along `cameras`. */
export async function moving(cameras) {
  renderer.show(cameras[0], 0);
  await renderer.settled();
  await nextFrame();
  [worked, waited] = [0, 0];
  const start = performance.now();
  for (const camera of cameras) {
    renderer.show(camera, 0);
    await nextFrame();
    finish();
  }
  const all = performance.now() - start;
  return { frame: all / cameras.length, main: worked / cameras.length };
}
