// The source of pixels that this browser is: it poses and draws the scene's file.

import { depthRange, pinhole } from "../camera.js";
import { CHANNELS, openEngine } from "./engine.js";

const REST_AFTER = 150; // milliseconds without a change, after which a frame counts as one that stays

export class LocalSource {
  label = "drawn here";
  views = CHANNELS;
  isSmooth = true;
  refused = false;

  /**
   * @param {object} viewer
   * @param {object} files
   * @param {string} files.runtime  address of the folder with onnxruntime-web's files
   * @param {(scene, tell) => Promise<ArrayBuffer>} files.file  the contents of a scene's file; `tell({ loaded, total })`
   */
  constructor(viewer, { runtime, file }) {
    Object.assign(this, { viewer, runtime, file });
    this.engine = null;
    this.canvas = null;
    this.opened = null; // SHA-256 of the file that the engine draws
    this.stop();
  }
}
