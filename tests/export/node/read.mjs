// What Niantic's library decodes of each .spz, and Khronos' validator says of each .glb, as the last line of the output.
import { readFileSync } from "node:fs";
import createSpz from "@adobe/spz";
import { validateBytes } from "gltf-validator";

const spz = await createSpz();
const found = [];
for (const file of process.argv.slice(2)) {
  const bytes = new Uint8Array(readFileSync(file));
  if (file.endsWith(".spz")) {
    const cloud = spz.loadSpzFromBuffer(bytes, { to: spz.CoordinateSystem.RDF });
    const arrays = ["positions", "scales", "rotations", "alphas", "colors", "sh"];
    const values = Object.fromEntries(arrays.map((name) => [name, Array.from(cloud[name])]));
    found.push({ ...values, antialiased: cloud.antialiased });
  } else {
    found.push((await validateBytes(bytes)).issues.messages);
  }
}
console.log(JSON.stringify(found));
