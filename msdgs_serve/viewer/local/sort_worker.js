// A worker that sorts Gaussians by depth, the farthest first.

const poses = []; // means of the moving Gaussians, by slot
let means = new Float32Array(0); // of the static ones
let [count, moving] = [0, 0];
let keys, ids, otherKeys, otherIds; // scratch
const histogram = new Uint32Array(1 << 16);
const depth = new Float32Array(1);
const depthBits = new Uint32Array(depth.buffer);

const actions = {
  constants(message) {
    ({ means, moving } = message);
    count = moving + means.length / 3;
    [keys, ids, otherKeys, otherIds] = [0, 1, 2, 3].map(() => new Uint32Array(count));
  },

  pose({ slot, means: posed }) {
    poses[slot] = posed;
  },

  /** `axis` and `shift`: depth = axis · mean + shift. `spent` is a buffer that may be written to. */
  sort({ first, second, share, axis, shift, near, spent }) {
    const start = performance.now();
    let found = keysOf(poses[first], 0, moving, axis, shift, near, 0, poses[second], share);
    found = keysOf(means, moving, count, axis, shift, near, found, means, 0);
    byDigit(found, keys, ids, otherKeys, otherIds, 0);
    byDigit(found, otherKeys, otherIds, keys, ids, 16);
    const order = spent?.byteLength === 4 * count ? new Uint32Array(spent) : new Uint32Array(count);
    for (let k = 0; k < found; k += 1) order[k] = ids[found - 1 - k];
    const milliseconds = performance.now() - start;
    self.postMessage({ kind: "sorted", order, found, milliseconds }, [order.buffer]);
  },
};

/** Append the keys and ids of the Gaussians `start` to `stop` that are in front of the near plane: the bits of a positive
 * float32 sort as the number does. Means are `a`, and towards `b` by `share`. Return the number of keys. */
function keysOf(a, start, stop, [x, y, z], shift, near, found, b, share) {
  for (let id = start, k = 0; id < stop; id += 1, k += 3) {
    let d = x * a[k] + y * a[k + 1] + z * a[k + 2];
    if (share > 0) d += share * (x * b[k] + y * b[k + 1] + z * b[k + 2] - d);
    d += shift;
    if (d > near) {
      depth[0] = d;
      keys[found] = depthBits[0];
      ids[found] = id;
      found += 1;
    }
  }
  return found;
}

/** One pass of a radix sort, stable, by 16 bits from `shift`. */
function byDigit(length, fromKeys, fromIds, toKeys, toIds, shift) {
  histogram.fill(0);
  for (let k = 0; k < length; k += 1) histogram[(fromKeys[k] >>> shift) & 0xffff] += 1;
  let sum = 0;
  for (let digit = 0; digit < histogram.length; digit += 1) {
    const size = histogram[digit];
    histogram[digit] = sum;
    sum += size;
  }
  for (let k = 0; k < length; k += 1) {
    const place = histogram[(fromKeys[k] >>> shift) & 0xffff]++;
    toKeys[place] = fromKeys[k];
    toIds[place] = fromIds[k];
  }
}

self.onmessage = ({ data }) => actions[data.kind](data);
