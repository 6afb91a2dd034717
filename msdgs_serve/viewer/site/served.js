// Says why nothing happens if the page was opened as a file, or in a frame without an origin, from which browsers load no
// modules, or if one is missing.

document.querySelector("script[type=module]").addEventListener("error", () => {
  if (location.protocol === "file:") return;
  const banner = document.getElementById("banner");
  banner.textContent =
    self.origin === "null"
      ? "The frame that this page is in keeps it from its files: the frame’s sandbox attribute needs allow-same-origin."
      : "A file of this page is missing below viewer/: the folder has to be copied as a whole.";
  banner.hidden = false;
});
if (location.protocol === "file:") {
  const folder = decodeURIComponent(location.pathname).replace(/[^/]*$/, "");
  const banner = document.getElementById("banner");
  banner.textContent =
    "Browsers show this page only if it comes from a server. This command is one, and the page is at http://localhost:8000 then: ";
  const command = document.createElement("code");
  command.textContent = `python -m http.server -d ${quoted(folder)}`;
  banner.append(command);
  banner.hidden = false;
}

/** A folder of an address as a word of a command, as its system's shells take it. */
function quoted(folder) {
  const onWindows = location.host ? `//${location.host}${folder}` : folder.match(/^\/([a-z]:.*)/i)?.[1];
  return onWindows ? `"${onWindows}"` : `'${folder.replaceAll("'", "'\\''")}'`;
}
