// Says why nothing happens if the page was opened as a file: browsers load no modules then.

if (location.protocol === "file:") {
  const folder = decodeURIComponent(location.pathname).replace(/\/[^/]*$/, "");
  const banner = document.getElementById("banner");
  banner.textContent =
    "Browsers show this page only if it comes from a server. This command is one, and the page is at http://localhost:8000 then: ";
  const command = document.createElement("code");
  command.textContent = `python -m http.server -d '${folder.replaceAll("'", "'\\''")}'`;
  banner.append(command);
  banner.hidden = false;
}
