"""The modules that draw in the browser, without WebGL: which poses are shown, the order, reading scene files."""

import json
import re
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page

from tests.support.scene_files import metadata

pytestmark = pytest.mark.slow

OPTIONAL = {"eps2d", "duration", "scene_to_world"}
"""Metadata that a file may lack."""

PLAY = """async ([poseSeconds, interpolates, times]) => {
    const { Poses } = await import("/viewer/local/poses.js");
    const [frame, shown, asked, slots] = [1 / 60, [], [], new Map()];
    let inFlight = null;
    const poses = new Poses({ interpolates, range: [0, 1] }, (pose) => {
        if (inFlight) throw new Error("asks for two poses at once");
        asked.push(pose.t);
        inFlight = { pose, due: now + poseSeconds };
    });
    let [now, inUse] = [0, new Set()];
    for (const [t, playing] of times) {
        now += frame;
        if (inFlight?.due <= now) {
            if (inUse.has(inFlight.pose.slot)) throw new Error("overwrites a pose that is shown");
            slots.set(inFlight.pose.slot, inFlight.pose.t);
            poses.received(inFlight.pose, 1000 * poseSeconds);
            inFlight = null;
        }
        const at = poses.at({ t, steps: null, playing }, now);
        if (at) {
            const { first, second, share, isExact } = at;
            inUse = new Set([first.slot, second.slot]);
            for (const { slot, t } of [first, second]) if (slots.get(slot) !== t) throw new Error("shows another pose");
            shown.push({ t, is: first.t + share * (second.t - first.t), share, isExact });
        } else shown.push(null);
    }
    return { shown, asked };
}"""
"""Runs frames of a display with [t, playing] each, and poses that take `poseSeconds`."""


def played(page: Page, pose_seconds: float, times: list[tuple[float, bool]], *, interpolates: bool = True) -> Any:
    return page.evaluate(PLAY, [pose_seconds, interpolates, times])


@pytest.mark.parametrize("pose_seconds", [0.001, 0.017, 0.08, 0.3])
def test_playback_shows_each_time_however_long_poses_take(modules: Page, pose_seconds: float):
    times = [(k / 600, True) for k in range(600)]
    shown = played(modules, pose_seconds, times)["shown"]
    began = int(8 * pose_seconds * 60) + 5
    off = [abs(each["is"] - each["t"]) for each in shown[began:]]
    assert max(off) < 1e-12
    assert any(0 < each["share"] < 1 for each in shown[began:])


def test_paused_it_shows_the_pose_at_its_time_and_asks_for_nothing_more(modules: Page):
    times = [(k / 600, True) for k in range(300)] + [(0.4987, False)] * 60
    told = played(modules, 0.05, times)
    assert told["shown"][-1] == {"t": 0.4987, "is": 0.4987, "share": 0, "isExact": True}
    assert told["asked"][-1] == 0.4987
    assert told["asked"].count(0.4987) == 1


def test_after_a_jump_back_it_goes_on_from_there(modules: Page):
    times = [((k % 300) / 300, True) for k in range(900)]
    shown = played(modules, 0.02, times)["shown"]
    for start in (300, 600):
        off = [abs(each["is"] - each["t"]) for each in shown[start + 15 : start + 300]]
        assert max(off) < 1e-12


def test_scrubbing_ends_at_the_last_time(modules: Page):
    rng = np.random.default_rng(0)
    times = [(float(t), False) for t in rng.uniform(0, 1, 50)] + [(0.25, False)] * 20
    assert played(modules, 0.06, times)["shown"][-1] == {"t": 0.25, "is": 0.25, "share": 0, "isExact": True}


def test_switched_frames_are_never_mixed(modules: Page):
    times = [(k / 120, True) for k in range(121)]
    told = played(modules, 0.03, times, interpolates=False)
    assert {each["share"] for each in told["shown"] if each} == {0}
    assert {each["is"] for each in told["shown"] if each} <= set(told["asked"])
    assert len(told["asked"]) > 20


SORT = """([moving, later, still, share, axis, shift, near]) => new Promise((resolve, reject) => {
    const worker = new Worker("/viewer/local/sort_worker.js", { type: "module" });
    worker.onerror = ({ message }) => reject(new Error(message));
    worker.onmessage = ({ data }) => resolve([...data.order.subarray(0, data.found)]);
    worker.postMessage({ kind: "constants", means: Float32Array.from(still), moving: moving.length / 3 });
    worker.postMessage({ kind: "pose", slot: 0, means: Float32Array.from(moving) });
    worker.postMessage({ kind: "pose", slot: 1, means: Float32Array.from(later) });
    worker.postMessage({ kind: "sort", first: 0, second: 1, share, axis, shift, near, spent: null });
})"""


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_gaussians_are_sorted_by_the_bits_of_their_depths(modules: Page, share: float):
    rng = np.random.default_rng(0)
    moving, later = (rng.normal(0, 1, (500, 3)).astype(np.float32) for _ in range(2))
    still = (rng.normal(0, 1, (700, 3)) * 10.0 ** rng.integers(-3, 6, (700, 1))).astype(np.float32)
    still[::7] = (1.0, 2.0, 3.0)  # of one depth
    axis, shift, near = np.array([0.6, 0.0, 0.8]), 1.0, 0.01
    arrays = [array.reshape(-1).tolist() for array in (moving, later, still)]
    order = modules.evaluate(SORT, [*arrays, share, axis.tolist(), shift, near])
    mixed = moving.astype(float) + share * (later.astype(float) - moving)
    exact = np.concatenate([mixed, still.astype(float)]) @ axis + shift
    depths = exact.astype(np.float32)
    assert set(order) == set(np.flatnonzero(exact > near).tolist())
    assert (np.diff(depths[order]) <= 0).all()
    same = np.diff(depths[order]) == 0
    assert same.any()
    assert (np.diff(order)[same] < 0).all(), "of equal depths the service blends the first one in front"


READ = """async (url) => {
    const { readSceneFile } = await import("/viewer/local/scene_file.js");
    const bytes = new Uint8Array(await (await fetch(url)).arrayBuffer());
    const [accepted, refused] = [[], []];
    for (let length = 0; length <= bytes.length; length += 1) {
        try {
            const read = readSceneFile(bytes.slice(0, length));
            accepted.push({ ...read, inputs: [...read.inputs] });
        } catch (error) {
            refused.push(`${error.constructor.name}: ${error.message}`);
        }
    }
    return { accepted, refused: [...new Set(refused)] };
}"""


def test_scene_files_are_read_whole_or_refused(modules: Page):
    name = modules.evaluate("async () => (await (await fetch('/scenes')).json()).scenes[0].name")
    told = modules.evaluate(READ, f"/scenes/{name}/file")
    whole = told["accepted"][-1]
    assert whole["metadata"] == {key: json.loads(value) for key, value in metadata().to_properties().items()}
    assert (set(whole["inputs"]), whole["idCount"], whole["selectsLast"]) == ({"t", "ids"}, 1, False)
    for cut in told["accepted"][:-1]:
        assert set(whole["metadata"]) - set(cut["metadata"]) <= OPTIONAL
    assert all(re.match("Error: (This isn’t a|The) scene file", each) for each in told["refused"])
