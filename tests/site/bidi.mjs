// Opens a page in a browser by WebDriver BiDi, and prints as JSON what a function resolves to there.
// node bidi.mjs ws://127.0.0.1:PORT URL FUNCTION

const [address, url, source] = process.argv.slice(2);
const socket = new WebSocket(`${address}/session`);
const waiting = new Map();

function call(method, params) {
  const id = waiting.size + 1;
  socket.send(JSON.stringify({ id, method, params }));
  return new Promise((resolve, reject) => waiting.set(id, { resolve, reject }));
}

socket.addEventListener("message", ({ data }) => {
  const { id, type, result, error, message } = JSON.parse(data);
  if (type === "success") waiting.get(id).resolve(result);
  else if (type === "error") waiting.get(id).reject(new Error(`${error}: ${message}`));
});
await new Promise((resolve, reject) => {
  socket.addEventListener("open", resolve);
  socket.addEventListener("error", () => reject(new Error("the browser doesn't answer")));
});

await call("session.new", { capabilities: {} });
const { contexts } = await call("browsingContext.getTree", {});
const { context } = contexts[0];
await call("browsingContext.navigate", { context, url, wait: "complete" });
const expression = `(${source})().then(JSON.stringify)`;
const done = await call("script.evaluate", { expression, target: { context }, awaitPromise: true });
if (done.exceptionDetails) throw new Error(done.exceptionDetails.text);
console.log(done.result.value);
socket.close();
