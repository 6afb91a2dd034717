"""Settings of the service, from flags and from the environment."""

import os
import re
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, Field
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError
from pydantic_settings import BaseSettings, EnvSettingsSource, PydanticBaseSettingsSource, SettingsConfigDict

from msdgs_serve.api.prefix import read_prefix
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import InvalidInput
from msdgs_serve.scene.onnx import GraphLimits
from msdgs_serve.store import SceneStore
from msdgs_serve.threads import thread_count

ORIGIN = re.compile(r"[a-z][a-z0-9+.-]*://[^/,\s\"'\]]+|null", re.IGNORECASE)
SIMILAR = 0.85
"""Least similarity of the name of an environment variable to that of a setting for which it is taken as misspelled."""


def one_per_thread(settings: dict[str, Any]) -> int:
    """Return the default number of concurrent renders; more slow each other down."""
    return min(settings.get("threads") or thread_count(), 64)


def _prefix(text: str) -> str:
    try:
        return read_prefix(text)
    except ValueError:
        message = "must be a path such as /msdgs: from /, without //, . or .., query and host, got '{given}'"
        raise PydanticCustomError("prefix", message, {"given": text[:100]}) from None


def _origin(text: str) -> str:
    origin = text.removesuffix("/")
    if text != "*" and not ORIGIN.fullmatch(origin):
        message = "must be origins such as https://example.org or http://localhost:3000, or *, got '{given}'"
        raise PydanticCustomError("origin", message, {"given": text[:100]})
    return origin


class CommonSettings(BaseModel):
    """Settings of most services."""

    host: str = Field(default="127.0.0.1", description="Address to listen on; 0.0.0.0 for all networks.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 for a free one.")
    threads: int | None = Field(default=None, ge=1, le=256, description="Render threads; by default one per core.")
    cache_megabytes: int = Field(default=256, ge=0, description="Memory of the cache of posed Gaussians.")
    sequence_megabytes: int = Field(
        default=128, ge=0, description="Memory of what stands still before cameras that are asked for repeatedly."
    )
    scenes_memory_megabytes: int = Field(
        default=2048, ge=1, description="Memory of all loaded scenes; those not requested for longest are unloaded."
    )
    api_keys_file: Path | None = Field(
        default=None,
        description="File with `scopes key` per line, scopes of read, write, operate; requests need a key then.",
    )
    cors_origins: list[Annotated[str, AfterValidator(_origin)]] = Field(
        default=[],
        description="Origins of web pages that may call, such as https://example.org, joined by commas; or *.",
    )
    proxies: str = Field(
        default="127.0.0.1",
        description="Addresses of trusted proxies for X-Forwarded-For, -Proto and -Prefix, joined by commas; or *.",
    )
    root_path: Annotated[str, AfterValidator(_prefix)] = Field(
        default="", description="Path below which a proxy serves, such as /msdgs; X-Forwarded-Prefix replaces it."
    )
    onnxruntime_web: Path | None = Field(
        default=None,
        description="Folder of the npm package onnxruntime-web, with which the web page can draw scenes by itself.",
    )
    frame_max_age: int = Field(
        default=0, ge=0, description="Seconds that caches may keep a frame without revalidation."
    )
    watch_seconds: float = Field(default=1.0, gt=0, description="Interval of checking files for changes.")
    drain_seconds: float = Field(default=30.0, ge=0, description="How long a stopping service finishes its requests.")
    compile: bool = Field(
        default=False, description="Compile kernels for this kind of processor and exit; needs no scene."
    )


class LimitSettings(BaseModel):
    """Limits of requests and scenes."""

    max_pixels: int = Field(
        default=4096 * 2160, ge=1, description="Largest width × height of a frame, multiplied by the number of times."
    )
    max_samples: int = Field(default=64, ge=1, description="Most samples of a frame's motion blur.")
    max_batch: int = Field(default=256, ge=1, le=1000, description="Most frames of a batch, and times of a request.")
    max_video_frames: int = Field(default=300, ge=1, le=1000, description="Most frames of a video.")
    max_video_pixels: int = Field(default=1 << 30, ge=1, description="Largest width × height × frames of a video.")
    concurrent_renders: int = Field(
        default_factory=one_per_thread,
        ge=1,
        le=64,
        description="Frames rendered at once, by default as many as threads; others wait.",
    )
    queued_renders: int = Field(
        default=32,
        ge=0,
        le=10_000,
        description="Frames that may wait, at most half of them of one client, and a quarter for its videos and "
        "batches; others get a 503.",
    )
    render_seconds: float = Field(default=30.0, gt=0, le=3600, description="Time limit of a frame, including waiting.")
    max_body_bytes: int = Field(default=1 << 20, ge=1024, description="Largest request body.")
    header_seconds: float = Field(default=10.0, gt=0, description="Time limit for a request's headers.")
    body_seconds: float = Field(
        default=10.0, gt=0, description="Time limit for a request's body; for uploads, for each part of it."
    )
    read_seconds: float = Field(default=10.0, gt=0, description="Time limit for reading each 64 KiB of a response.")
    unread_megabytes: int = Field(
        default=512,
        ge=1,
        description="Memory of responses that clients have yet to read, about half of it for one client; new requests "
        "for frames get a 503 meanwhile.",
    )
    max_scene_gaussians: int = Field(default=40_000_000, ge=1, description="Most Gaussians of a scene.")
    max_scene_memory_megabytes: int = Field(
        default=2048, ge=1, description="Most memory for the values of one call of a scene's graph and for all poses."
    )
    max_scene_operations: float = Field(
        default=1e13, gt=0, description="Most operations of a scene's graph for one frame."
    )


class UploadSettings(BaseModel):
    """Uploads and their limits."""

    uploads: bool = Field(default=False, description="Let clients add and delete scenes, in the first folder given.")
    max_scene_megabytes: int = Field(default=1024, ge=1, description="Largest uploaded scene file.")
    max_scenes: int = Field(default=1000, ge=1, description="Most scenes in the folder for uploads.")
    max_scenes_megabytes: int = Field(default=1 << 16, ge=1, description="Most disk space of these scenes.")
    max_key_scenes: int = Field(default=100, ge=1, description="Most scenes of one API key in that folder.")
    max_key_megabytes: int = Field(default=1 << 13, ge=1, description="Most disk space of the scenes of one API key.")
    min_free_megabytes: int = Field(default=1024, ge=0, description="Disk space that uploads leave free.")
    trial_seconds: float = Field(
        default=60.0,
        gt=0,
        le=3600,
        description="Time limit for opening an uploaded scene and posing it at three times.",
    )


class LogSettings(BaseModel):
    """Format and level of the log."""

    log_format: Literal["text", "json"] = Field(default="text", description="`json`: one object per line.")
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="warning", description="`info` logs every request and invalid upload."
    )


class Settings(LogSettings, UploadSettings, LimitSettings, CommonSettings, BaseSettings):
    """All settings; what isn't given is read from the environment."""

    model_config = SettingsConfigDict(env_prefix="MSDGS_", extra="ignore", env_ignore_empty=True)

    scenes: list[Path] = Field(
        default=[], description="Scene files (.onnx) and folders of them; in the environment joined by ':'."
    )

    @property
    def graph_limits(self) -> GraphLimits:
        """Limits of a scene's cost."""
        return GraphLimits(self.max_scene_gaussians, self.max_scene_memory_megabytes << 20, self.max_scene_operations)

    def open_store(self) -> SceneStore:
        """Return the store of the scenes, which opens files within these limits."""
        open_scene = partial(DeformationSession, limits=self.graph_limits)
        return SceneStore(self.scenes, open_scene, self.scenes_memory_megabytes << 20)

    @classmethod
    def settings_customise_sources(
        cls, settings_cls: type[BaseSettings], init_settings: PydanticBaseSettingsSource, **_: Any
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Return the sources in order: arguments, environment."""
        return init_settings, _Environment(settings_cls)


def split_list(name: str, value: str) -> list[str]:
    """Return the parts of a setting that is a list: paths are joined as in PATH, others by commas."""
    if name == "scenes":
        return [part for part in value.split(os.pathsep) if part]
    return [part.strip() for part in value.split(",") if part.strip()]


def _similar(name: str, known: list[str]) -> str | None:
    """The setting that a misspelled or shortened name stands for, with or without underscores; None if it is none."""
    shortened = [each for each in known if each.replace("_", "").startswith(name.replace("_", ""))]
    return next(iter(get_close_matches(name, known, 1, SIMILAR) or shortened), None)


class _Environment(EnvSettingsSource):
    def __call__(self) -> dict[str, Any]:
        """Read variables; raises `InvalidInput` for one whose name is almost that of a setting, such as a file of keys
        that nobody would read."""
        prefix, names = self.env_prefix.lower(), self.settings_cls.model_fields
        for variable in os.environ:
            name = variable.lower().removeprefix(prefix)
            if name == variable.lower() or name in names:
                continue
            if name and (meant := _similar(name, list(names))):
                raise InvalidInput(variable, f"called {self.env_prefix}{meant.upper()}", "a name that isn't read")
        return super().__call__()

    def decode_complex_value(self, field_name: str, field: FieldInfo, value: Any) -> Any:
        """Split lists instead of parsing JSON."""
        return split_list(field_name, value)
