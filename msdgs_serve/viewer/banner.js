// The line about what is wrong.

/** Say what is wrong; nothing if `text` is empty. */
export function say(text) {
  const banner = document.getElementById("banner");
  if (banner.textContent !== text) banner.textContent = text; // else it is read aloud again
  banner.hidden = !text;
}

/** Take back a text, unless another one has replaced it. */
export function unsay(text) {
  if (document.getElementById("banner").textContent === text) say("");
}
