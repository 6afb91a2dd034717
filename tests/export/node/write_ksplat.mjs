// a.ply a.ksplat LEVEL DEGREE SECTION BLOCK BUCKET: the conversion of the viewer whose format it is.
import { readFileSync, writeFileSync } from "node:fs";
import { PlyParser, SplatBufferGenerator } from "@mkkellogg/gaussian-splats-3d";

const [source, output, ...numbers] = process.argv.slice(2);
const [level, degree, section, block, bucket] = numbers.map(Number);
const splats = PlyParser.parseToUncompressedSplatArray(new Uint8Array(readFileSync(source)).buffer, degree);
const generator = SplatBufferGenerator.getStandardGenerator(1, level, section, undefined, block, bucket);
writeFileSync(output, new Uint8Array(generator.generateFromUncompressedSplatArray(splats).bufferData));
