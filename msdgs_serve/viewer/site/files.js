// The files of the folder that belong to the scene.

import { download } from "../local/download.js";

const DESCRIPTION = "scene.json";
const FIRST_BYTE = 0x08; // of an ONNX file: the tag of its version
const AGAIN = "Reload the page; if that doesn’t help, the folder has to be written again.";

/** The description of the scene, as GET /scenes/{name} has it, with the `file`: its path, and its size in bytes. */
export async function description() {
  const bytes = await download(DESCRIPTION, `The file ${DESCRIPTION}`, () => {});
  try {
    return JSON.parse(new TextDecoder().decode(bytes));
  } catch {
    throw new Error(`The file ${DESCRIPTION} isn’t the one that was written for this page. ${AGAIN}`);
  }
}

/** The bytes of the scene's file, if it is the described one. Rejects with an Error for people. */
export async function sceneFile({ file, sha256 }, tell = () => {}) {
  const name = `The scene’s file ${file.path}`;
  const bytes = await download(file.path, name, (loaded) => tell({ loaded, total: file.stored }));
  if (bytes.length && bytes[0] !== FIRST_BYTE) throw new Error(`${name} isn’t a scene: it begins with other bytes. ${AGAIN}`);
  if (bytes.length < file.size) {
    throw new Error(`${name} ends too early: it was not copied or sent as a whole. ${AGAIN}`);
  }
  if (bytes.length > file.size || !(await isDigest(sha256, bytes))) {
    throw new Error(`${name} isn’t the one that this page was written for: it has changed since. ${AGAIN}`);
  }
  return bytes.buffer;
}

/** Whether bytes have a SHA-256, in hexadecimal. Pages that came neither by HTTPS nor from this machine can't tell. */
async function isDigest(sha256, bytes) {
  if (!crypto.subtle) return true;
  const found = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  return Array.from(found, (byte) => byte.toString(16).padStart(2, "0")).join("") === sha256;
}
