// What Niantic's library decodes of an .spz, and Khronos' validator says of a .glb, as the last line of the output.
import { readFileSync } from "node:fs";
import createSpz from "@adobe/spz";
import { validateBytes } from "gltf-validator";

const file = process.argv[2];
const bytes = new Uint8Array(readFileSync(file));
let found;
if (file.endsWith(".spz")) {
  const spz = await createSpz();
  const cloud = spz.loadSpzFromBuffer(bytes, { to: spz.CoordinateSystem.RDF });
  const arrays = ["positions", "scales", "rotations", "alphas", "colors", "sh"];
  found = Object.fromEntries(arrays.map((name) => [name, Array.from(cloud[name])]));
  found.antialiased = cloud.antialiased;
} else {
  found = (await validateBytes(bytes)).issues.messages;
}
console.log(JSON.stringify(found));
