// Downloads with progress. Contents that are gzipped, as a folder on a plain file server has them, are unpacked.

const GZIP = [0x1f, 0x8b];

/**
 * Return the bytes behind an address, or of an ArrayBuffer.
 * @param {string | ArrayBuffer} source
 * @param {string} what  its name in errors
 * @param {(loaded: number, total: number) => void} progress  bytes; `total` is 0 if the server doesn't tell
 * @returns {Promise<Uint8Array>}
 */
export async function download(source, what, progress) {
  if (typeof source !== "string") return unpacked(new Uint8Array(source), what);
  // Servers that don't say how long a file stays the same leave that to browsers, whose guess would mix old and new files.
  const response = await fetch(source, { cache: "no-cache" }).catch(() => {
    throw new Error(`${what} can’t be loaded: the server doesn’t answer.`);
  });
  if (!response.ok) throw new Error(`${what} can’t be loaded: the server answered ${response.status}.`);
  const total = response.headers.has("Content-Encoding") ? 0 : Number(response.headers.get("Content-Length"));
  let loaded = 0;
  const counter = new TransformStream({
    transform(part, out) {
      loaded += part.length;
      progress(loaded, total);
      out.enqueue(part);
    },
  });
  const contents = new Response(response.body.pipeThrough(counter)).arrayBuffer();
  const bytes = await contents.catch(() => {
    throw new Error(`${what} can’t be loaded: the connection broke.`);
  });
  return unpacked(new Uint8Array(bytes), what);
}

async function unpacked(bytes, what) {
  if (bytes[0] !== GZIP[0] || bytes[1] !== GZIP[1]) return bytes;
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const contents = new Response(stream).arrayBuffer();
  return new Uint8Array(
    await contents.catch(() => {
      throw new Error(`${what} is damaged, or was not copied or sent as a whole.`);
    }),
  );
}
