// Calls of the service. URLs are relative, so that the page works behind a proxy's prefix.

const KEY = "msdgs-key";

export class Unreachable extends Error {
  message = "The service doesn’t answer. Trying again…";
  retryAfter = 1;
}

/**
 * An error response; `detail` is for people, `fields` are the invalid fields of the request. `retryAfter`, seconds, is
 * null if only another request or another file can help.
 */
export class Refusal extends Error {
  constructor(status, problem, retryAfter) {
    super(problem.detail ?? `The service answered ${status}.`);
    this.status = status;
    this.fields = (problem.errors ?? []).map((error) => error.field);
    this.retryAfter = retryAfter;
  }
}

/** Whether an error says that something isn't there. */
export const isMissing = (error) => error instanceof Refusal && error.status === 404;

export const readKey = () => sessionStorage.getItem(KEY) ?? "";

export function keepKey(key) {
  if (key) sessionStorage.setItem(KEY, key);
  else sessionStorage.removeItem(KEY);
}

/** Return the response, if it is a success or "not modified". Throws `Unreachable`, `Refusal`, or an AbortError. */
export async function call(path, { headers = {}, ...options } = {}) {
  const key = readKey();
  const authorization = key ? { Authorization: `Bearer ${key}` } : {};
  let response;
  try {
    response = await fetch(path, { ...options, headers: { ...headers, ...authorization }, credentials: "omit" });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Unreachable();
  }
  if (response.ok || response.status === 304) return response;
  const problem = await response.json().catch(() => null);
  const isOfProxy = response.status === 502 || (response.status === 503 && !problem);
  if (isOfProxy) throw new Unreachable(); // the proxy doesn't reach the service
  const wait = response.headers.get("Retry-After");
  throw new Refusal(response.status, problem ?? {}, wait && (Number(wait) || 1));
}

export const scenePath = (name) => `scenes/${encodeURIComponent(name)}`;

/** Return a response's body, read by `blob()` or `json()`. Throws `Unreachable` if the connection breaks. */
export async function received(body) {
  try {
    return await body;
  } catch (error) {
    throw error instanceof TypeError ? new Unreachable() : error;
  }
}

export const getJson = async (path, options) => received((await call(path, options)).json());

/** POST /render. */
export function render(body, { signal, etag } = {}) {
  const headers = { "Content-Type": "application/json", ...(etag ? { "If-None-Match": etag } : {}) };
  return call("render", { method: "POST", headers, body: JSON.stringify(body), signal });
}
