// The WebGL2 resources of a scene, and one frame of it.

import { BLEND_FRAGMENT, BLEND_VERTEX, NOTHING, ROW_BITS, SPLAT, STILL, projectShader } from "./shaders.js";

const ROW = 1 << ROW_BITS;
const SPLAT_NUMBERS = SPLAT.reduce((sum, [, length]) => sum + length, 0);
const CHANNELS = ["rgb", "alpha", "depth"];
const SLOTS = 3; // poses: two that are shown, and the next
const LAYOUTS = {
  means: ["RGB32F", "RGB", 3],
  quats: ["RGBA32F", "RGBA", 4],
  scales: ["RGB32F", "RGB", 3],
  opacities: ["R32F", "RED", 1],
  sh: ["RGB16F", "RGB", 3],
};

export class Graphics {
  /** `scene` has metadata, moving, gaussians, changing. Throws an Error without WebGL2. */
  constructor(canvas, scene) {
    this.canvas = canvas;
    this.scene = scene;
    const options = { alpha: false, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" };
    this.gl = canvas.getContext("webgl2", options);
    if (!this.gl) throw new Error("This browser doesn’t draw with WebGL2, or it is switched off.");
    this.restore();
  }

  get isLost() {
    return this.gl.isContextLost();
  }

  /** Make all resources, at first and after a lost context; the arrays have to be set again. */
  restore() {
    const { gl, scene } = this;
    const { sh_degree: degree } = scene.metadata;
    this.found = 0; // splats that are drawn
    this.hasFloats = gl.getExtension("EXT_color_buffer_float") !== null;
    this.project = program(gl, projectShader({ degree, changing: scene.changing }), NOTHING, SPLAT);
    this.blend = program(gl, BLEND_VERTEX, BLEND_FRAGMENT);
    const posed = ["means", "quats", "scales", ...scene.changing];
    this.still = texturesOf(gl, STILL);
    this.poses = Array.from({ length: SLOTS }, () => texturesOf(gl, posed));
    const samplers = [...STILL, ...posed.flatMap((name) => [`${name}A`, `${name}B`])];
    gl.useProgram(this.project);
    samplers.forEach((name, unit) => gl.uniform1i(gl.getUniformLocation(this.project, name), unit));
    this.#makeBuffers();
    this.target = this.hasFloats ? { buffer: gl.createFramebuffer(), texture: null, size: "" } : null;
  }

  #makeBuffers() {
    const { gl } = this;
    [this.order, this.splats] = [gl.createBuffer(), gl.createBuffer()];
    [this.ids, this.quads] = [gl.createVertexArray(), gl.createVertexArray()];
    gl.bindVertexArray(this.ids);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.splats);
    gl.bufferData(gl.ARRAY_BUFFER, Math.max(this.scene.gaussians, 1) * 4 * SPLAT_NUMBERS, gl.DYNAMIC_COPY);
    let offset = 0;
    SPLAT.forEach(([, length], location) => {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, length, gl.FLOAT, false, 4 * SPLAT_NUMBERS, 4 * offset);
      gl.vertexAttribDivisor(location, 1);
      offset += length;
    });
    gl.bindVertexArray(null);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
  }

  /** Set what doesn't depend on time, arrays by name. */
  setConstants(arrays) {
    for (const name of STILL) upload(this.gl, this.still[name], name, arrays[name]);
  }

  /** Set the arrays of a pose. */
  setPose(slot, arrays) {
    for (const [name, array] of Object.entries(arrays)) upload(this.gl, this.poses[slot][name], name, array);
  }

  /** Set the order in which the Gaussians are drawn, of which the first `found` are. */
  setOrder(order, found) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    this.found = found;
  }

  /** Draw a view from `viewOf`, of the poses in two slots and the share of the way between them. */
  draw(view, { first, second, share }, channel) {
    const { gl, canvas, scene } = this;
    const { width, height } = view;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    this.#bindTextures(first.slot, second.slot);
    this.#project(view, share, channel);
    if (this.target) this.#bindTarget(width, height);
    const [red, green, blue] = channel === "rgb" ? scene.metadata.background : [0, 0, 0];
    gl.clearColor(red, green, blue, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.#blend(width, height);
    if (!this.target) return;
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  #bindTextures(first, second) {
    const { gl } = this;
    const [before, after] = [this.poses[first], this.poses[second]];
    const textures = [
      ...Object.values(this.still),
      ...Object.keys(before).flatMap((name) => [before[name], after[name]]),
    ];
    textures.forEach(({ texture }, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
  }

  #project(view, share, channel) {
    const { gl, project, scene } = this;
    const { metadata } = scene;
    gl.useProgram(project);
    const at = (name) => gl.getUniformLocation(project, name);
    gl.uniform1i(at("moving"), scene.moving);
    gl.uniform1f(at("share"), share);
    gl.uniformMatrix3fv(at("rotation"), true, view.rotation.flat());
    gl.uniform3fv(at("eye"), view.eye);
    gl.uniform2f(at("focal"), view.fx, view.fy);
    gl.uniform2f(at("principal"), view.cx, view.cy);
    gl.uniform2f(at("size"), view.width, view.height);
    gl.uniform4fv(at("limits"), view.limits);
    gl.uniform1f(at("eps2d"), metadata.eps2d);
    gl.uniform1i(at("mip"), metadata.antialiasing === "mip");
    gl.uniform1i(at("channel"), CHANNELS.indexOf(channel));
    gl.uniform2fv(at("depths"), view.depths);
    gl.bindVertexArray(this.ids);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.splats);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.found);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
  }

  #blend(width, height) {
    const { gl } = this;
    gl.useProgram(this.blend);
    gl.uniform2f(gl.getUniformLocation(this.blend, "size"), width, height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.quads);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.found);
    gl.bindVertexArray(null);
  }

  /** Blend in 16-bit floats: 8 bits lose faint splats. */
  #bindTarget(width, height) {
    const { gl, target } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    if (target.size === `${width}×${height}`) return;
    gl.deleteTexture(target.texture);
    target.texture = gl.createTexture();
    target.size = `${width}×${height}`;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, target.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.texture, 0);
  }

  /** The pixels of the frame that was drawn in this task. */
  read() {
    const { width, height } = this.canvas;
    const copy = new OffscreenCanvas(width, height).getContext("2d");
    copy.drawImage(this.canvas, 0, 0); // reading from WebGL would stall it
    return copy.getImageData(0, 0, width, height);
  }

  dispose() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}

function texturesOf(gl, names) {
  return Object.fromEntries(names.map((name) => [name, { texture: gl.createTexture(), height: 0 }]));
}

/** Write an array into a texture, row by row; the last row may be filled in part. */
function upload(gl, texture, name, array) {
  const [internal, format, numbers] = LAYOUTS[name];
  const texels = array.length / numbers;
  const [whole, rest] = [Math.floor(texels / ROW), texels % ROW];
  const height = Math.max(Math.ceil(texels / ROW), 1);
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, texture.texture);
  if (texture.height !== height) {
    checkSize(gl, height);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl[internal], ROW, height, 0, gl[format], gl.FLOAT, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    texture.height = height;
  }
  if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, whole, gl[format], gl.FLOAT, array);
  if (!rest) return;
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, rest, 1, gl[format], gl.FLOAT, array, whole * ROW * numbers);
}

function checkSize(gl, height) {
  const limit = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  if (height <= limit) return;
  throw new Error(`The scene is too large for this graphics card: textures of ${height} rows, and ${limit} are possible.`);
}

function program(gl, vertex, fragment, outputs = []) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  if (outputs.length) {
    gl.transformFeedbackVaryings(made, outputs.map(([name]) => name), gl.INTERLEAVED_ATTRIBS);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`WebGL2 refuses a shader: ${[gl.getProgramInfoLog(made), ...logs].join(" ")}`);
  }
  return made;
}
