// Programs, textures and targets of WebGL2.

import { ROW_BITS } from "./shaders.js";

const ROW = 1 << ROW_BITS;
const LAYOUTS = {
  order: ["R32UI", "RED_INTEGER", "UNSIGNED_INT", 1],
  means: ["RGB32F", "RGB", "FLOAT", 3],
  quats: ["RGBA32F", "RGBA", "FLOAT", 4],
  scales: ["RGB32F", "RGB", "FLOAT", 3],
  opacities: ["R32F", "RED", "FLOAT", 1],
  sh: ["RGB16F", "RGB", "FLOAT", 3],
};

/** A texture that holds an array, row by row. */
export class Texels {
  constructor(gl, name) {
    this.gl = gl;
    this.texture = nearest(gl);
    this.height = 0;
    this.layout = LAYOUTS[name];
  }

  /** Write an array; the last row may be filled in part. */
  write(array) {
    const { gl } = this;
    const [internal, format, type, numbers] = this.layout;
    const texels = array.length / numbers;
    const [whole, rest] = [Math.floor(texels / ROW), texels % ROW];
    const height = Math.max(Math.ceil(texels / ROW), 1);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    if (this.height !== height) {
      checkSize(gl, height);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl[internal], ROW, height, 0, gl[format], gl[type], null);
      this.height = height;
    }
    const write = (row, width, rows, start) =>
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, rows, gl[format], gl[type], array, start);
    if (whole) write(0, ROW, whole, 0);
    if (rest) write(whole, rest, 1, whole * ROW * numbers);
  }
}

class Program {
  constructor(gl, handle) {
    this.gl = gl;
    this.handle = handle;
    this.places = new Map();
  }

  use() {
    this.gl.useProgram(this.handle);
  }

  /** The location of a uniform. */
  at(name) {
    if (!this.places.has(name)) this.places.set(name, this.gl.getUniformLocation(this.handle, name));
    return this.places.get(name);
  }

  setUnits(samplers) {
    this.use();
    samplers.forEach((name, unit) => this.gl.uniform1i(this.at(name), unit));
  }

  /** Bind textures in the order of the samplers. */
  bind(textures) {
    const { gl } = this;
    textures.forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
  }
}

export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  const shaders = [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].map(([kind, source]) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    return shader;
  }); // prettier-ignore
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = shaders.map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`WebGL2 refuses a shader: ${[gl.getProgramInfoLog(made), ...logs].join(" ")}`);
  }
  return new Program(gl, made);
}

/** A framebuffer with textures of some formats. */
export function target(gl, formats, width, height) {
  checkSize(gl, Math.max(width, height));
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.activeTexture(gl.TEXTURE0);
  const textures = formats.map((format, index) => {
    const texture = nearest(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + index, gl.TEXTURE_2D, texture, 0);
    return texture;
  });
  gl.drawBuffers(textures.map((_, index) => gl.COLOR_ATTACHMENT0 + index));
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  const remove = () => {
    gl.deleteFramebuffer(framebuffer);
    for (const texture of textures) gl.deleteTexture(texture);
  };
  return { framebuffer, textures, width, height, remove };
}

function nearest(gl) {
  const texture = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

function checkSize(gl, size) {
  const limit = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  if (size <= limit || gl.isContextLost()) return;
  throw new Error(`The scene or its image is too large for this graphics card: ${size} rows of ${limit} at most.`);
}
