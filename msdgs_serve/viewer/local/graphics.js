// The WebGL2 resources of a scene, and one frame of it.

import {
  BLEND_FRAGMENT, BLEND_VERTEX, BRIGHTEST, EVERYWHERE, MOVING, RESOLVE, ROW_BITS, STILL, projectShader,
  samplersOf,
} from "./shaders.js"; // prettier-ignore
import { Texels, program, target } from "./webgl.js";

/** Channels that are drawn. */
export const CHANNELS = ["rgb", "alpha", "depth"];

const SLOTS = 3; // poses: two that are shown, and the next
const CONTEXT = { alpha: false, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" };

/** The WebGL2 context of a canvas that has none yet. Throws an Error for people if there is none. */
export function contextOf(canvas) {
  canvas.hidden = true; // until it has a frame: it is black
  const gl = canvas.getContext("webgl2", CONTEXT);
  if (!gl) throw new Error("This browser doesn’t draw with WebGL2, or it is switched off.");
  return gl;
}

export class Graphics {
  /** `scene` has metadata, moving, gaussians, and changing: those of opacities and SH that depend on time. */
  constructor(gl, scene) {
    this.gl = gl;
    this.canvas = gl.canvas;
    this.scene = scene;
    const posed = [...MOVING, ...scene.changing];
    this.found = 0; // Gaussians that are drawn
    this.project = program(gl, EVERYWHERE, projectShader({ degree: scene.metadata.sh_degree, posed }));
    this.blend = program(gl, BLEND_VERTEX, BLEND_FRAGMENT);
    this.resolve = program(gl, EVERYWHERE, RESOLVE);
    const textures = (names) => Object.fromEntries(names.map((name) => [name, new Texels(gl, name)]));
    this.order = new Texels(gl, "order");
    this.still = textures(STILL);
    this.poses = Array.from({ length: SLOTS }, () => textures(posed));
    this.project.setUnits(samplersOf(posed));
    this.blend.setUnits(["placed", "painted"]);
    const rows = Math.max(Math.ceil(scene.gaussians / (1 << ROW_BITS)), 1);
    this.splats = target(gl, [gl.RGBA32UI, gl.RGBA32UI], 1 << ROW_BITS, rows);
    this.frame = null;
  }

  get isLost() {
    return this.gl.isContextLost();
  }

  /** Set what doesn't depend on time, arrays by name. */
  setConstants(arrays) {
    for (const name of STILL) this.still[name].write(arrays[name]);
  }

  /** Set the arrays of a pose. */
  setPose(slot, arrays) {
    for (const [name, array] of Object.entries(arrays)) this.poses[slot][name].write(array);
  }

  /** Set the order in which Gaussians are blended: their ids, the first `found` of an array. */
  setOrder(order, found) {
    this.order.write(order);
    this.found = found;
  }

  /** Draw a view from `viewOf`, of poses in two slots and the share of the way between them. */
  draw(view, { first, second, share }, channel) {
    const { gl, canvas } = this;
    const { width, height } = view;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    this.#project(view, this.poses[first.slot], this.poses[second.slot], share, channel);
    if (this.frame?.width !== width || this.frame?.height !== height) {
      this.frame?.remove();
      this.frame = target(gl, [gl.RGB10_A2], width, height); // 8 bits lose faint splats
    }
    this.#blend(channel === "rgb" ? this.scene.metadata.background : [0, 0, 0]);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.resolve.use();
    this.resolve.bind(this.frame.textures);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    canvas.hidden = false;
  }

  #project(view, before, after, share, channel) {
    const { gl, project, scene, found } = this;
    const { metadata } = scene;
    project.use();
    gl.uniform1i(project.at("found"), found);
    gl.uniform1i(project.at("moving"), scene.moving);
    gl.uniform1f(project.at("share"), share);
    gl.uniformMatrix3fv(project.at("rotation"), true, view.rotation.flat());
    gl.uniform3fv(project.at("eye"), view.eye);
    gl.uniform2f(project.at("focal"), view.fx, view.fy);
    gl.uniform2f(project.at("principal"), view.cx, view.cy);
    gl.uniform2f(project.at("size"), view.width, view.height);
    gl.uniform4fv(project.at("limits"), view.limits);
    gl.uniform1f(project.at("eps2d"), metadata.eps2d);
    gl.uniform1i(project.at("mip"), metadata.antialiasing === "mip");
    gl.uniform1i(project.at("channel"), CHANNELS.indexOf(channel));
    gl.uniform2fv(project.at("depths"), view.depths);
    const posed = Object.keys(before).flatMap((name) => [before[name], after[name]]);
    project.bind([this.order, ...Object.values(this.still), ...posed].map(({ texture }) => texture));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.splats.framebuffer);
    gl.viewport(0, 0, this.splats.width, Math.max(Math.ceil(found / this.splats.width), 1));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  #blend(background) {
    const { gl, blend, frame, found } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame.framebuffer);
    gl.viewport(0, 0, frame.width, frame.height);
    gl.clearColor(...background.map((x) => x / BRIGHTEST), 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!found) return;
    blend.use();
    gl.uniform2f(blend.at("size"), frame.width, frame.height);
    blend.bind(this.splats.textures);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.TRIANGLES, 0, 3 * found);
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
