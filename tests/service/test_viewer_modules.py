"""The page's modules: the camera equals the service's, times are in range, and frame sizes follow the frame time."""

import numpy as np
import pytest
from playwright.sync_api import Page

from msdgs_serve.scene.camera import orbit
from tests.support.scene_files import metadata
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0), (0.3, 0.2, 0.9)])
def test_the_camera_is_the_services_own(modules: Page, up: tuple[float, float, float]):
    view = {"target": [0.5, 1, -2], "distance": 3, "up": up, "fov_y": 40, "width": 4, "height": 3}
    script = """async (view) => {
        const { Camera } = await import("/viewer/camera.js");
        const camera = new Camera(view);
        camera.orbit(-75, 15);
        const { right, above, forward } = camera.axes;
        return [right, above.map((x) => -x), forward, camera.eye]; }"""
    columns = np.array(modules.evaluate(script, view)).T
    wanted = orbit(np.array(view["target"]), 3, 30 - 75, 20 + 15, np.array(up))
    assert np.abs(columns - wanted[:3]).max() < tolerance("rotation")


def test_a_pose_from_the_scene_is_kept(modules: Page):
    stored = metadata().cameras[1]
    script = """async ([view, stored]) => {
        const { Camera } = await import("/viewer/camera.js");
        const camera = new Camera(view);
        camera.take(stored, 1);
        const { right, above, forward } = camera.axes;
        return [right, above.map((x) => -x), forward, camera.eye]; }"""
    view = {"target": [0.5, 0, 0.25], "distance": 3, "up": [0, 0, 1], "fov_y": 40, "width": 4, "height": 3}
    columns = np.array(modules.evaluate(script, [view, stored.to_plain()])).T
    assert np.abs(columns - stored.camera.camera_to_world[:3]).max() < tolerance("rotation")


def test_a_stored_camera_may_look_straight_down(modules: Page):
    script = """async ([view, stored]) => {
        const { Camera } = await import("/viewer/camera.js");
        const camera = new Camera(view);
        camera.take(stored, 0);
        return [camera.elevation, ...camera.target]; }"""
    view = {"target": [0.5, 0, 0.25], "distance": 3, "up": [0, 0, 1], "fov_y": 40, "width": 4, "height": 3}
    rounded = [[1, 0, 0, 0.5], [0, -1, 0, 0], [0, 0, -1.0000001, 3.25], [0, 0, 0, 1]]
    stored = {"camera_to_world": rounded, "width": 4, "height": 3, "fy": 4}
    assert modules.evaluate(script, [view, stored]) == pytest.approx([89, *view["target"]], abs=1e-5)


@pytest.mark.parametrize("size", [0, 1e-15, 1, 1e6])
def test_the_range_of_depths_has_an_extent(modules: Page, size: float):
    script = """async ([view, bounds]) => {
        const { Camera, depthRange } = await import("/viewer/camera.js");
        return depthRange(new Camera(view), bounds); }"""
    view = {"target": [0.5, 0, 0.25], "distance": 3, "up": [0, 0, 1], "fov_y": 40, "width": 4, "height": 3}
    near, far = modules.evaluate(script, [view, [[0, 0, 0], [size, 0, 0]]])
    assert 0 <= near < 3 < far


@pytest.mark.parametrize(("first", "last"), [(0, 1), (1 / 30, 1), (2 / 3, 7 / 3), (123456.78, 123456.9), (-1e9, 1e9)])
def test_times_are_distinct_in_range_and_exact_at_both_ends(modules: Page, first: float, last: float):
    script = """async (range) => {
        const { Player } = await import("/viewer/player.js");
        const player = new Player();
        player.range = range;
        const times = Array.from({ length: 1001 }, (_, i) => player.at(i / 1000));
        return [times, times.map((t) => (player.seekTime(t), player.t))]; }"""
    times, sought = modules.evaluate(script, [first, last])
    assert (times[0], times[-1]) == (first, last)
    assert times == sorted(set(times))
    assert sought == times, "as the address gives them"


@pytest.mark.parametrize("duration", [1, 4, 60, 3600])
def test_playback_has_other_times_with_each_frame_however_long_the_scene_is(modules: Page, duration: float):
    script = """async (duration) => {
        const { Player } = await import("/viewer/player.js");
        const player = new Player();
        player.open({ time_range: [0, duration], duration, changes: true });
        player.start();
        const times = Array.from({ length: 29 }, () => (player.advance(1 / 30), player.t));
        player.seek(0);
        player.step(1);
        return [times, player.t]; }"""
    times, step = modules.evaluate(script, duration)
    assert len(set(times)) == len(times)
    assert 0 < step <= 1 / 30


@pytest.mark.parametrize(
    ("parts", "lens"),
    [
        ("", {}),
        ("fov=77.3", {"fov": 77.3}),
        ("fov=20&proportion=0.5", {"fov": 20, "proportion": 0.5}),
        ("fov=0&proportion=0", {}),
        ("fov=180&proportion=-1", {}),
        ("fov=wide&proportion=", {}),
        ("fov=Infinity&proportion=NaN", {}),
    ],
)
def test_impossible_lenses_of_links_are_left_out(modules: Page, parts: str, lens: dict[str, float]):
    script = """async (parts) => {
        const { fromHash } = await import("/viewer/share.js");
        return JSON.parse(JSON.stringify(fromHash(`#at=0,0,1,0,0,0&${parts}`).lens)); }"""
    assert modules.evaluate(script, parts) == lens


@pytest.mark.parametrize(("first", "last"), [(0, 1), (-1.605, 0.016)])
def test_motion_ends_within_the_range_of_times(modules: Page, first: float, last: float):
    script = """async (range) => {
        const { Player } = await import("/viewer/player.js");
        const { frameBody } = await import("/viewer/service/request.js");
        const player = new Player();
        player.range = range;
        player.seek(1);
        const { t, dt } = frameBody({ scene: {}, camera: {}, player, view: "motion", layers: { steps: null } });
        return [t, dt]; }"""
    t, dt = modules.evaluate(script, [first, last])
    assert t + dt <= last
    assert dt == pytest.approx((last - first) / 50)


@pytest.mark.parametrize(("pose", "nanoseconds_per_pixel"), [(0.002, 20.0), (0.02, 100.0), (0.02, 1000.0)])
def test_moving_frames_come_15_times_per_second(modules: Page, pose: float, nanoseconds_per_pixel: float):
    script = """async ([pose, aPixel]) => {
        const { Pace } = await import("/viewer/service/pace.js");
        const pace = new Pace();
        const taken = [];
        for (let i = 0; i < 20; i += 1) {
          const { width, height } = pace.size({ width: 1600, height: 1200 });
          const drawing = width * height * aPixel;
          taken.push([width * height, pose + drawing]);
          pace.measured(width * height, pose + drawing, drawing);
        }
        return taken; }"""
    taken = modules.evaluate(script, [pose, nanoseconds_per_pixel * 1e-9])
    pixels, seconds = taken[-1]
    assert seconds < 1 / 15
    affordable = (1 / 15 - pose) / (nanoseconds_per_pixel * 1e-9)
    assert pixels > 0.5 * min(affordable, 1600 * 1200), "fewer pixels than affordable"


@pytest.mark.parametrize(("pose", "nanoseconds_per_pixel"), [(0.0, 2500.0), (0.0, 100_000.0), (0.6, 20.0)])
def test_slow_moving_frames_become_small_and_are_shown(
    modules: Page, page: Page, pose: float, nanoseconds_per_pixel: float
):
    """The clock is simulated: at first a frame of 600 x 400 pixels takes at least 0.6 s."""
    script = """async ([pose, aPixel]) => {
        const { Frames } = await import("/viewer/service/frames.js");
        const { Pace } = await import("/viewer/service/pace.js");
        window.taken = [];
        window.createImageBitmap = async () => ({ close() {} });
        window.fetch = (_, { body, signal }) => new Promise((answer, reject) => {
          const { width, height } = JSON.parse(body);
          const drawing = width * height * aPixel;
          const headers = new Headers({ "Server-Timing": `draw;dur=${1000 * drawing}` });
          signal.addEventListener("abort", () => reject(signal.reason));
          setTimeout(() => answer({ ok: true, headers, blob: async () => null }), 1000 * (pose + drawing));
        });
        const host = {
          size: () => ({ width: 1200, height: 800 }),
          body: () => ({}),
          isMoving: () => true,
          isPlaying: () => false,
          show: (_, { seconds }) => taken.push(seconds),
        };
        const frames = new Frames(host, new Pace());
        frames.paused = false;
        const tick = () => (frames.change(), requestAnimationFrame(tick));
        tick(); }"""
    page.clock.install(time=0)
    page.goto(modules.url)
    page.clock.pause_at(1000)
    page.evaluate(script, [pose, nanoseconds_per_pixel * 1e-9])
    page.clock.run_for(10_000)
    taken = page.evaluate("taken")
    smallest = pose + 128 * 96 * nanoseconds_per_pixel * 1e-9
    assert taken[-1] < max(1 / 15, smallest + 1 / 30)
    assert sum(taken) > 8, "hardly a frame came after the first ones"


def test_playback_asks_for_30_frames_per_second_of_which_two_are_in_flight(modules: Page, page: Page):
    """The clock is simulated: a frame takes 20 ms on the service and 30 ms on its way."""
    script = """async () => {
        const { Frames } = await import("/viewer/service/frames.js");
        const { Pace } = await import("/viewer/service/pace.js");
        Object.assign(window, { asked: [], shown: [], playing: true, t: 0, most: 0 });
        window.createImageBitmap = async () => ({ close() {} });
        let inFlight = 0;
        window.fetch = (_, { body }) => new Promise((answer) => {
          asked.push([performance.now(), JSON.parse(body)]);
          most = Math.max(most, inFlight += 1);
          const headers = new Headers({ "Server-Timing": "pose;dur=5, draw;dur=15" });
          setTimeout(() => (inFlight -= 1, answer({ ok: true, headers, blob: async () => null })), 50);
        });
        const host = {
          size: () => ({ width: 600, height: 400 }),
          body: () => ({ t }),
          isMoving: () => playing,
          isPlaying: () => playing,
          show: (_, { full }) => shown.push([full, asked.length]),
        };
        window.frames = new Frames(host, new Pace());
        frames.paused = false;
        const tick = () => (playing && ((t += 1), frames.change()), requestAnimationFrame(tick));
        tick(); }"""
    page.clock.install(time=0)
    page.goto(modules.url)
    page.clock.pause_at(1000)
    page.evaluate(script)
    page.clock.run_for(10_000)
    times = [at for at, _ in page.evaluate("asked")]
    assert 280 <= len(times) <= 302
    assert page.evaluate("most") == 2
    page.evaluate("playing = false; frames.change()")
    page.clock.run_for(1000)
    last = page.evaluate("asked.at(-1)[1]")
    assert (last["format"], last["t"]) == ("png", page.evaluate("t")), "the exact frame"
    assert page.evaluate("shown.at(-1)[0]") is True


def test_a_frame_that_was_overtaken_is_not_shown(modules: Page, page: Page):
    script = """async () => {
        const { Frames } = await import("/viewer/service/frames.js");
        const { Pace } = await import("/viewer/service/pace.js");
        const answers = [];
        const shown = [];
        window.createImageBitmap = async (blob) => ({ blob, close() {} });
        window.fetch = (_, { body }) => new Promise((answer) => {
          const { t } = JSON.parse(body);
          answers.push(() => answer({ ok: true, headers: new Headers(), blob: async () => t }));
        });
        let t = 0;
        const host = {
          size: () => ({ width: 60, height: 40 }),
          body: () => ({ t: (t += 1) }),
          isMoving: () => true,
          isPlaying: () => true,
          show: ({ blob }) => shown.push(blob),
        };
        const frames = new Frames(host, new Pace());
        frames.paused = false;
        const drawn = () => new Promise((done) => setTimeout(done, 100));
        frames.change();
        await drawn();
        frames.change();
        answers[1]();
        await drawn();
        answers[0]();
        await drawn();
        return shown; }"""
    page.goto(modules.url)
    assert page.evaluate(script) == [2]


def test_a_static_scene_is_not_played(modules: Page):
    script = """async () => {
        const { Player } = await import("/viewer/player.js");
        const player = new Player();
        player.start();
        const before = player.playing;
        player.open({ time_range: [0, 1], duration: null, changes: false });
        const stopped = player.playing;
        player.start();
        return [before, stopped, player.playing, player.t]; }"""
    assert modules.evaluate(script) == [True, False, False, 0]
