// What a page needs from a scene file itself (docs/contract.md): metadata, and the graph's inputs.
// onnxruntime-web neither returns metadata nor takes inputs that have a default.

const [GRAPH, METADATA] = [7, 14]; // fields of ModelProto
const [INITIALIZER, INPUT] = [5, 11]; // fields of GraphProto
const UNUSED = (3 << 3) | 2; // tag of a field that GraphProto doesn't have: readers skip it
const CONTRACTS = ["msdgs/1", "msdgs/2"];
const TRUNCATED = "The scene file ends too early: it was not copied or sent as a whole.";

/**
 * Read a scene file, and remove the defaults of `ids` and `steps` from it in place: a byte of each, so that nothing is
 * copied. Returns the values of `metadata_props`, the set of the graph's inputs, and the length of the default of `ids`,
 * null without it. Throws an Error for a file that isn't a whole scene file.
 * @param {Uint8Array} bytes
 */
export function readSceneFile(bytes) {
  const [metadata, inputs] = [{}, new Set()];
  let idCount = null;
  for (const field of fields(bytes, 0, bytes.length)) {
    if (field.number === METADATA) {
      const [key, value] = texts(bytes, field);
      metadata[key] = parsed(key, value);
    } else if (field.number === GRAPH) {
      for (const part of fields(bytes, field.start, field.end)) {
        if (part.number === INPUT) inputs.add(textOf(bytes, part, 1));
        if (part.number !== INITIALIZER) continue;
        const name = textOf(bytes, part, 8);
        if (name !== "ids" && name !== "steps") continue;
        if (name === "ids") idCount = lengthOf(bytes, part);
        bytes[part.tag] = UNUSED;
      }
    }
  }
  if (!metadata.contract) throw new Error("This isn’t a scene file of msdgs.");
  if (!CONTRACTS.includes(metadata.contract)) {
    throw new Error(`The scene file has the contract ${metadata.contract}; this page reads ${CONTRACTS.join(" and ")}.`);
  }
  return { metadata, inputs, idCount };
}

/** Yield the fields of a message: its number, the place of its tag, and where its value starts and ends. */
function* fields(bytes, at, end) {
  while (at < end) {
    const tag = at;
    const key = varint(bytes, at);
    const number = Math.floor(key.value / 8);
    let start = key.next;
    let stop = start;
    const kind = key.value % 8;
    if (kind === 0) stop = varint(bytes, start).next;
    else if (kind === 1) stop += 8;
    else if (kind === 5) stop += 4;
    else if (kind === 2) {
      const length = varint(bytes, start);
      start = length.next;
      stop = start + length.value;
    } else throw new Error("This isn’t a scene file of msdgs.");
    if (stop > end) throw new Error(TRUNCATED);
    yield { number, tag, start, end: stop };
    at = stop;
  }
}

function varint(bytes, at) {
  let [value, unit] = [0, 1];
  for (; ; at += 1, unit *= 128) {
    if (at >= bytes.length) throw new Error(TRUNCATED);
    value += (bytes[at] & 127) * unit;
    if (bytes[at] < 128) return { value, next: at + 1 };
  }
}

const decoded = (bytes, { start, end }) => new TextDecoder().decode(bytes.subarray(start, end));

const texts = (bytes, { start, end }) => [...fields(bytes, start, end)].map((field) => decoded(bytes, field));

/** The text in the field `number` of a message. */
function textOf(bytes, { start, end }, number) {
  for (const field of fields(bytes, start, end)) if (field.number === number) return decoded(bytes, field);
  return "";
}

/** The first dimension of a TensorProto. */
function lengthOf(bytes, { start, end }) {
  for (const field of fields(bytes, start, end)) if (field.number === 1) return varint(bytes, field.start).value;
  return 0;
}

function parsed(key, value) {
  try {
    return JSON.parse(value);
  } catch {
    throw new Error(`The scene file’s metadata can’t be read: “${key}” isn’t JSON.`);
  }
}
