"""What can be set, from flags and from the environment, by one definition."""

import os
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from pydantic.fields import FieldInfo
from pydantic_settings import (
    BaseSettings,
    CliImplicitFlag,
    CliPositionalArg,
    EnvSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.onnx import GraphLimits
from msdgs_serve.threads import thread_count

PROGRAM = "msdgs-serve"


def cores() -> int:
    """Frames that are drawn at once where nothing else is said: more get in each other's way."""
    return min(thread_count(), 64)


class Settings(BaseSettings):
    """\
    Serve scenes over HTTP: POST /render returns a frame for any camera and any time.

      msdgs-serve scene.onnx                  one scene
      msdgs-serve scenes/ --port 9000         every .onnx file of a folder; files may come, change and go
      msdgs-serve --compile                   compile now, so that the next start needn't, and stop
      MSDGS_SCENES=scenes/ msdgs-serve        every flag can be given as an environment variable, MSDGS_ before its name

    A scene file comes from `python export/to_onnx.py model.pt`. Once it listens, /docs explains each call.
    """

    model_config = SettingsConfigDict(
        env_prefix="MSDGS_",
        cli_prog_name=PROGRAM,
        cli_kebab_case=True,
        cli_hide_none_type=True,
        extra="ignore",
        env_ignore_empty=True,
    )

    scenes: CliPositionalArg[list[Path]] = Field(
        default=[], description="scene files (.onnx) and folders of them; in the environment joined by ':'"
    )
    host: str = Field(default="127.0.0.1", description="address to listen on; 0.0.0.0 for all networks")
    port: int = Field(default=8000, ge=0, le=65535, description="port to listen on; 0 takes a free one")
    max_pixels: int = Field(
        default=4096 * 2160, ge=1, description="largest width × height of a frame; × times, where there are several"
    )
    max_body_bytes: int = Field(default=1 << 20, ge=1024, description="largest request body")
    concurrent_renders: int = Field(
        default_factory=cores, ge=1, le=64, description="frames in work at once; others wait"
    )
    queued_renders: int = Field(
        default=32, ge=0, le=10_000, description="frames that may wait, of one client at most half; others get a 503"
    )
    render_seconds: float = Field(default=30.0, gt=0, le=3600, description="time limit of a frame, waiting included")
    cache_megabytes: int = Field(default=256, ge=0, description="memory for Gaussians posed before")
    max_samples: int = Field(default=64, ge=1, description="most moments of a frame's motion blur")
    max_batch: int = Field(default=256, ge=1, le=1000, description="most frames of a batch, and times of a frame")
    max_video_frames: int = Field(default=300, ge=1, le=1000, description="most frames of a film")
    max_video_pixels: int = Field(default=1 << 30, ge=1, description="largest width × height × frames of a film")
    max_scene_megabytes: int = Field(default=1024, ge=1, description="largest scene file that is taken in")
    max_scenes: int = Field(default=1000, ge=1, description="most scenes in the folder for uploads")
    max_scenes_megabytes: int = Field(default=1 << 16, ge=1, description="most that they take together")
    max_key_scenes: int = Field(default=100, ge=1, description="most scenes there of one key")
    max_key_megabytes: int = Field(default=1 << 13, ge=1, description="most that they take together")
    min_free_megabytes: int = Field(default=1024, ge=0, description="of the disk, what uploads leave free")
    max_scene_memory_megabytes: int = Field(
        default=2048, ge=1, description="most memory for the values of one call of a scene's graph and for all poses"
    )
    max_scene_gaussians: int = Field(default=40_000_000, ge=1, description="most Gaussians of a scene")
    max_scene_operations: float = Field(
        default=1e13, gt=0, description="most operations of a scene's graph for one frame"
    )
    trial_seconds: float = Field(
        default=60.0, gt=0, le=3600, description="time limit for opening and posing an uploaded scene once"
    )
    uploads: CliImplicitFlag[bool] = Field(
        default=False, description="let clients add and delete scenes, in the first folder given"
    )
    header_seconds: float = Field(default=10.0, gt=0, description="time limit for a request's headers")
    body_seconds: float = Field(default=10.0, gt=0, description="time limit for a request's body; for uploads, idle")
    read_seconds: float = Field(default=10.0, gt=0, description="how long a client may take no bytes of its answer")
    drain_seconds: float = Field(default=30.0, ge=0, description="how long a stopping service finishes what it has")
    watch_seconds: float = Field(default=1.0, gt=0, description="how often files are looked at for changes")
    frame_max_age: int = Field(default=0, ge=0, description="seconds that caches may keep a frame without asking")
    api_keys_file: Path | None = Field(
        default=None, description="`scopes key` a line, of read, write, operate; without a key no request is answered"
    )
    proxies: str = Field(
        default="127.0.0.1", description="addresses whose X-Forwarded-For is believed, joined by commas; or *"
    )
    cors_origins: list[str] = Field(default=[], description="web pages that may call, as https://example.org; or *")
    compile: CliImplicitFlag[bool] = Field(
        default=False, description="store compiled kernels for this kind of processor and stop; needs no scene"
    )
    threads: int | None = Field(
        default=None, ge=1, le=256, description="threads that compute; default: one for each core"
    )
    log_format: Literal["text", "json"] = Field(default="text", description="`json`: one object a line")
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="warning", description="`info` logs every request"
    )

    @property
    def graph_limits(self) -> GraphLimits:
        """What the graph of a scene may take."""
        return GraphLimits(self.max_scene_gaussians, self.max_scene_memory_megabytes << 20, self.max_scene_operations)

    def open_scene(self, path: Path) -> DeformationSession:
        """A scene file within these limits. Raises `SceneFileInvalid`."""
        return DeformationSession(path, limits=self.graph_limits)

    @classmethod
    def settings_customise_sources(
        cls, settings_cls: type[BaseSettings], init_settings: PydanticBaseSettingsSource, **_: Any
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Flags (put first by pydantic-settings), then arguments, then the environment."""
        return init_settings, _Environment(settings_cls)


class _Environment(EnvSettingsSource):
    def decode_complex_value(self, field_name: str, field: FieldInfo, value: Any) -> Any:
        """A list of paths is written as PATH is, one of web pages with commas; not as JSON."""
        separator = os.pathsep if field_name == "scenes" else ","
        return [part for part in value.split(separator) if part]
