// What can be taken away from the service's page, as Exports wants it.

import { linkTo } from "../share.js";
import { call, readKey, render, scenePath } from "./api.js";
import { frameBody, numbersBody } from "./request.js";

/** `size()` is that of a full frame. */
export function takesOf(viewer, size) {
  const frame = async (body) => {
    const contents = await (await render({ ...body, ...size() })).blob();
    return { contents, name: `${viewer.scene.name}-${viewer.player.t}.${body.format}` };
  };
  return {
    link: () => linkTo(viewer),
    curl: () => curlCommand({ ...frameBody(viewer), ...size(), format: "png" }),
    png: () => frame({ ...frameBody(viewer), format: "png" }),
    exr: () => frame(numbersBody(viewer)),
    onnx: async () => {
      const { name } = viewer.scene;
      return { contents: await (await call(`${scenePath(name)}/file`)).blob(), name: `${name}.onnx` };
    },
  };
}

/** Return the curl command for the frame, without the API key. */
function curlCommand(body) {
  const key = readKey() ? " -H \"Authorization: Bearer $MSDGS_KEY\"" : "";
  const address = quoted(new URL("render", document.baseURI).href);
  const output = `-o frame.${body.format}`;
  return `curl ${address}${key} -H 'Content-Type: application/json' ${output} -d ${quoted(JSON.stringify(body))}`;
}

/** Quote a text for a shell. */
const quoted = (text) => `'${text.replaceAll("'", "'\\''")}'`;
