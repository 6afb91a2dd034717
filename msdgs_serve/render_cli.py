"""`msdgs-render`: render a camera path through scenes as images or a video, on this machine or a Ray cluster.

After Ctrl-C the same command continues where it was stopped.
"""

import argparse
import hashlib
import itertools
import json
import math
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import cast, get_args

import numpy as np
import OpenImageIO as oiio

from msdgs_serve.blocks import Block, OutputOptions, View, draw_block, plan_blocks
from msdgs_serve.camera_path import DEFAULT_FPS, CameraPath, check_fps, orbit_path, read_path_file, read_scene_names
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.imaging import FORMATS, ImageFormat
from msdgs_serve.imaging.encode import check_encodable
from msdgs_serve.imaging.formats import DEFAULT_QUALITY, default_channels
from msdgs_serve.process import EXIT_INTERRUPTED, EXIT_INVALID
from msdgs_serve.ray_blocks import draw_on_ray
from msdgs_serve.ray_tasks import ray_cluster
from msdgs_serve.renderer import Renderer, RenderOptions, check_times
from msdgs_serve.scene import InvalidInput, MsdgsError, Region
from msdgs_serve.video import PIXELS, VIDEO_FORMATS, VideoFormat, check_size, pixels_of, require_pyav, write_video
from msdgs_serve.writing import in_words, replacing, write_text, writing

PROGRAM = "msdgs-render"
RECORD = "msdgs-render.json"
DEFAULT_FRAMES, DEFAULT_ELEVATION = 60, 20.0
"""Of a turn around the scene; the elevation in degrees."""
OPTIONS = ("elevation", "width", "height", "region", "fps", "quality", "dt")
"""Those whose values are checked where they are used, by these names."""

DESCRIPTION = """\
Render a camera path through scenes as images or a video, on this machine or a Ray cluster.

  msdgs-render scene.onnx frames/                           one turn around the scene over its time range, as PNG
  msdgs-render scene.onnx turn.mp4 --frames 96 --fps 24     the same as a video
  msdgs-render scene.onnx walk.webm --path camera_path.json a path saved by nerfstudio's viewer
  msdgs-render scene.onnx frames/ --format exr --dt 0.02    color, alpha, depth and motion vectors, for compositing
  msdgs-render views.json frames/                           a path whose cameras each name their "scene"
  msdgs-render scene.onnx frames/ --ray auto                on the Ray cluster of this machine, or at an address
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. Return the exit status: 2 after an error, 130 after Ctrl-C."""
    options = _parser().parse_args(arguments)
    try:
        _run(options)
    except KeyboardInterrupt:
        print(f"\n{PROGRAM}: stopped; the same command continues from here", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (MsdgsError, OSError) as error:
        print(f"{PROGRAM}: {in_words(_by_option(error, options))}", file=sys.stderr)
        return EXIT_INVALID
    return 0


def _by_option(error: MsdgsError | OSError, options: argparse.Namespace) -> MsdgsError | OSError:
    """The error, with the name of the option that gave the invalid value, if one did."""
    if isinstance(error, InvalidInput):
        name = error.field.removeprefix("camera.")
        if name in OPTIONS and getattr(options, name) is not None:
            return error.renamed(f"--{name}")
        if name == "background" and options.transparent:
            return InvalidInput("--transparent", f"left out for {options.format}, which has no alpha", "given")
    return error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        PROGRAM,
        usage="%(prog)s [-h] [OPTIONS] SCENE OUT",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    scene = 'Scene file (.onnx), or camera path (.json) in which each camera names one as "scene".'
    parser.add_argument("scene", type=Path, metavar="SCENE", help=scene)
    out = "Folder for images, or video: name.mp4, name.webm or name.webp, which needs pip install 'msdgs[video]'."
    parser.add_argument("out", type=Path, metavar="OUT", help=out)
    _add_path_options(parser.add_argument_group("cameras and times"))
    _add_output_options(parser.add_argument_group("images and videos"))
    ray = "Render on a Ray cluster: `auto` for that of this machine (started if there is none), or its address."
    parser.add_argument_group("more machines").add_argument("--ray", metavar="ADDRESS", help=ray)
    return parser


def _add_path_options(group: argparse._ArgumentGroup) -> None:
    path = "Camera path in nerfstudio's format; by default one turn around the scene during its time range."
    group.add_argument("--path", type=Path, metavar="JSON", help=path)
    frames = f"Frames of the turn. (default: {DEFAULT_FRAMES})"
    group.add_argument("--frames", type=int, metavar="COUNT", help=frames)
    elevation = f"Elevation of the turn above the horizon. (default: {DEFAULT_ELEVATION:g})"
    group.add_argument("--elevation", type=float, metavar="DEGREES", help=elevation)
    width = "Image width; by default the path's, else that of the scene's first camera."
    group.add_argument("--width", type=int, metavar="PIXELS", help=width)
    group.add_argument("--height", type=int, metavar="PIXELS", help="Image height, given together with --width.")
    region = "Part of each image that is drawn: its left upper corner, width and height, in pixels."
    group.add_argument("--region", type=int, nargs=4, metavar=("X", "Y", "WIDTH", "HEIGHT"), help=region)


def _add_output_options(group: argparse._ArgumentGroup) -> None:
    fps = f"Frames per second of a video; by default the path's, else {DEFAULT_FPS:g}."
    group.add_argument("--fps", type=float, help=fps)
    group.add_argument("--format", choices=get_args(ImageFormat), help="Format of images. (default: png)")
    quality = f"Quality of jpeg and webp images, 1 to 100. (default: {DEFAULT_QUALITY})"
    group.add_argument("--quality", type=int, metavar="NUMBER", help=quality)
    motion = "EXR and NPY also hold motion vectors, from each frame's time to this much later, in the scene's time."
    group.add_argument("--dt", type=float, metavar="TIME", help=motion)
    group.add_argument("--transparent", action="store_true", help="Render images without a background.")


def _run(options: argparse.Namespace) -> None:
    video = "" if options.out.is_dir() else options.out.suffix.lstrip(".")
    is_video = bool(video)
    if is_video:
        if video not in VIDEO_FORMATS:
            names = " or ".join(f".{name}" for name in VIDEO_FORMATS)
            expected = f"a folder (of a name with a dot: an existing one), or a video named {names}"
            raise InvalidInput("OUT", expected, options.out.name)
        require_pyav(cast(VideoFormat, video))
    _refuse(options, ["format", "quality"] if is_video else ["fps"], "for images" if is_video else "for a video")
    image_format = cast(ImageFormat, options.format or "png")
    if options.dt is not None and (is_video or not FORMATS[image_format].holds_float):
        raise InvalidInput("--dt", "left out, as only exr and npy hold motion vectors", options.dt)
    if options.dt is not None and not 0 < options.dt < math.inf:
        raise InvalidInput("--dt", "above 0", options.dt)
    views, fps = _views(options)
    transparent = options.transparent or (FORMATS[image_format].holds_float and not is_video)
    region = None if options.region is None else Region(*options.region)
    if region:
        for view in views:
            region.check(view.camera)
    first = region or views[0].camera
    check_encodable(first.width, first.height, transparent, image_format, options.quality)
    if is_video:
        check_size(cast(VideoFormat, video), first.width, first.height)
        if transparent:
            raise InvalidInput("--transparent", "left out for a video", "given")
    folder = options.out.with_name(f"{options.out.name}.frames") if is_video else options.out
    _claim(folder, _record(options, views, image_format, transparent))
    files = [folder / f"frame_{number:05d}{FORMATS[image_format].extension}" for number in range(len(views))]
    background = "transparent" if transparent else "scene"
    has_depth = "depth" in default_channels(image_format)
    drawn = RenderOptions(background, motion_dt=options.dt, depth=has_depth, region=region)
    _draw(views, files, OutputOptions(image_format, options.quality, drawn), options.ray)
    if is_video:
        with replacing(options.out) as temporary, temporary.open("wb") as file:
            write_video(_images(files), fps, cast(VideoFormat, video), file)
        shutil.rmtree(folder)
    print(f"wrote {options.out}: {len(files)} frames of {first.width} × {first.height}")
    if is_video and pixels_of(cast(VideoFormat, video), first.width, first.height) != PIXELS:
        print("Some players, such as QuickTime, show MP4 of even sizes only; .webm and .webp have any size.")


def _refuse(options: argparse.Namespace, names: Sequence[str], what: str) -> None:
    """Raise `InvalidInput` for options that are given and have no effect, as they are for something else."""
    for name in names:
        if (value := getattr(options, name)) is not None:
            raise InvalidInput(f"--{name}", f"left out: it is {what}", value)


def _views(options: argparse.Namespace) -> tuple[list[View], float]:
    """Return all frames, and the frames per second of a video."""
    if (options.width is None) != (options.height is None):
        raise InvalidInput("--width", "given together with --height", "only one of them")
    if _is_path(options.scene) or options.path is not None:
        _refuse(options, ["frames", "elevation"], "for a turn around the scene, not for a camera path")
    if _is_path(options.scene):
        return _views_of_scenes(options)
    path = _path(options, _opened(options.scene, options))
    return [View(options.scene, camera, t) for camera, t in path.frames], path.fps


def _is_path(file: Path) -> bool:
    """Whether the first argument is a camera path."""
    return file.suffix.lower() == ".json"


def _views_of_scenes(options: argparse.Namespace) -> tuple[list[View], float]:
    if options.path is not None:
        raise InvalidInput("--path", "left out if the first argument is a camera path", options.path)
    scenes = [options.scene.parent / name for name in read_scene_names(options.scene)]
    ranges = {scene: _opened(scene, options).scene.metadata.time_range for scene in dict.fromkeys(scenes)}
    paths = {scene: read_path_file(options.scene, time_range, _size(options)) for scene, time_range in ranges.items()}
    _print_warnings(options.scene, paths[scenes[0]])
    views = [View(scene, *paths[scene].frames[number]) for number, scene in enumerate(scenes)]
    return views, _fps(options, paths[scenes[0]].fps)


def _opened(scene: Path, options: argparse.Namespace) -> DeformationSession:
    """Open a scene, and check that it has motion if that is to be drawn."""
    if not scene.is_file():
        raise InvalidInput("SCENE", "a scene file (.onnx) or a camera path (.json)", f"{scene}, which is none")
    session = DeformationSession(scene)
    if options.dt is not None:
        check_times(session, session.scene.metadata.time_range[0], motion_dt=options.dt)
    return session


def _path(options: argparse.Namespace, session: DeformationSession) -> CameraPath:
    metadata, size = session.scene.metadata, _size(options)
    if options.path is not None:
        path = read_path_file(options.path, metadata.time_range, size)
        _print_warnings(options.path, path)
        return CameraPath(path.frames, _fps(options, path.fps))
    count = DEFAULT_FRAMES if options.frames is None else options.frames
    if count < 1:
        raise InvalidInput("--frames", "at least 1", count)
    elevation = DEFAULT_ELEVATION if options.elevation is None else options.elevation
    view = framing(metadata)
    size = size or (view.width, view.height)
    frames = orbit_path(view.target, view.distance, elevation, view.up, view.fov_y, size, count, metadata.time_range)
    return CameraPath(tuple(frames), _fps(options, DEFAULT_FPS))


def _print_warnings(file: Path, path: CameraPath) -> None:
    for warning in path.warnings:
        print(f"{PROGRAM}: warning: {file}: {warning}", file=sys.stderr)


def _fps(options: argparse.Namespace, default: float) -> float:
    if options.fps is None:
        return default
    check_fps(options.fps)
    return options.fps


def _size(options: argparse.Namespace) -> tuple[int, int] | None:
    return None if options.width is None else (options.width, options.height)


def _draw(views: Sequence[View], files: Sequence[Path], look: OutputOptions, ray: str | None) -> None:
    """Draw the files that don't exist yet; each is written atomically."""
    missing = [number for number, file in enumerate(files) if not file.exists()]
    if len(missing) < len(files):
        print(f"{len(files) - len(missing)} of {len(files)} frames exist already")
    if not missing:
        return
    with writing(files[0].parent), ExitStack() as stack:
        if ray is None:
            frames = _draw_here(plan_blocks(views, missing), look)
        else:
            cores = stack.enter_context(ray_cluster(ray))
            print(f"Ray has {cores} cores", file=sys.stderr)
            frames = draw_on_ray(plan_blocks(views, missing, cores), look, cores)
        started = time.monotonic()
        for done, (number, body) in enumerate(frames, start=1):
            with replacing(files[number]) as temporary:
                temporary.write_bytes(body)
            _show_progress(done, len(missing), time.monotonic() - started)


def _draw_here(blocks: Sequence[Block], look: OutputOptions) -> Iterator[tuple[int, bytes]]:
    renderer = Renderer()
    for scene, of_one_scene in itertools.groupby(blocks, lambda block: block.scene):
        session = DeformationSession(scene)
        for block in of_one_scene:
            yield from draw_block(block, session, renderer, look)


def _show_progress(done: int, count: int, seconds: float) -> None:
    if sys.stderr.isatty() or done in (1, count):
        left = seconds / done * (count - done)
        end = "\n" if done == count or not sys.stderr.isatty() else ""
        text = f"\rframe {done} of {count}, {done / max(seconds, 1e-9):.2f} per second, {left:.0f} s left   "
        print(text, end=end, file=sys.stderr, flush=True)


def _images(files: Sequence[Path]) -> Iterator[np.ndarray]:
    """Yield the images, [H, W, 3] uint8."""
    for file in files:
        reader = oiio.ImageInput.open(str(file))
        pixels = None
        if reader:
            pixels = reader.read_image(oiio.UINT8)
            reader.close()
        if pixels is None:
            oiio.geterror()  # otherwise the library prints it at the end
            raise InvalidInput("frame", "a readable image; delete it to have it drawn again", file)
        yield pixels[..., :3]


def _record(options: argparse.Namespace, views: Sequence[View], image_format: str, transparent: bool) -> str:
    """Return a text that identifies the frames: formats, and a digest of scenes, cameras and times."""
    digest = hashlib.sha256()
    contents = {scene: hashlib.sha256(scene.read_bytes()).digest() for scene in {view.scene for view in views}}
    for scene, camera, t in views:
        digest.update(contents[scene])
        digest.update(repr((camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, t)).encode())
        digest.update(camera.camera_to_world.tobytes())
    asked = {"format": image_format, "quality": options.quality, "transparent": transparent}
    asked |= {name: value for name in ("dt", "region") if (value := getattr(options, name)) is not None}
    return json.dumps({**asked, "sha256": digest.hexdigest()})


def _claim(folder: Path, record: str) -> None:
    """Create the folder, or check that its frames belong to the same command."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / RECORD
    if file.exists():
        if file.read_text(encoding="utf-8", errors="replace") != record:
            expected = "a folder without frames of another command: delete them, or repeat that command"
            raise InvalidInput("OUT", expected, folder)
        return
    if any(not each.name.startswith(".") for each in folder.iterdir()):
        raise InvalidInput("OUT", "an empty folder, or one of an earlier run of this command", folder)
    write_text(file, record)


if __name__ == "__main__":
    sys.exit(main())
