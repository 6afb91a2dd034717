"""The steps of a job: each writes its result as a whole and is skipped while all that it depends on is unchanged."""

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from msdgs_serve.writing import temporary_folder, write_text
from msdgs_train.capture.progress import Progress

Watch = Callable[[str, bool], AbstractContextManager[Progress]]
"""Called with the name of a step and whether its result is kept from an earlier run."""

MARK = "step.json"
"""The file in a finished step's folder."""


class Steps:
    """Steps of one job in their order. Each fills the folder of its name below `folder`.

    A step's fingerprint covers its settings and the fingerprint of the step before it. A step whose fingerprint is
    that of its stored result is skipped; one that runs removes the results of all steps that follow.
    """

    def __init__(
        self, results: Mapping[str, Sequence[str]], folder: Path, start: str, *, force: str | None, watch: Watch
    ) -> None:
        """`results` has for each step what it puts beside `folder`, in this order; `start` stands for the inputs of the
        first step; the step `force` runs even if nothing has changed."""
        self._results, self._folder = results, folder
        self._fingerprint, self._force, self._watch = start, force, watch

    def path(self, name: str) -> Path:
        """The folder with the result of a step."""
        return self._folder / name

    def do(self, name: str, settings: Mapping[str, Any], run: Callable[[Path, Progress], None]) -> None:
        """Run a step, which fills the folder that it is given, or keep its result. Ctrl-C and errors leave nothing of
        it."""
        content = json.dumps([name, dict(settings), self._fingerprint], sort_keys=True)
        self._fingerprint = hashlib.sha256(content.encode()).hexdigest()
        is_kept = name != self._force and self._stored(name) == self._fingerprint
        with self._watch(name, is_kept) as progress:
            if is_kept:
                return
            self.discard_from(name)
            self._folder.mkdir(parents=True, exist_ok=True)
            with temporary_folder(self._folder, self.path(name)) as temporary:
                result = temporary / name
                result.mkdir()
                run(result, progress)
                for part in self._results[name]:
                    if (result / part).exists():
                        (result / part).rename(self._folder.parent / part)
                write_text(result / MARK, json.dumps({"fingerprint": self._fingerprint}) + "\n")
                result.rename(self.path(name))

    def discard_from(self, name: str) -> None:
        """Remove the results of a step and of all that follow it."""
        names = list(self._results)
        for later in names[names.index(name) :]:
            for part in reversed(self._results[later]):
                _remove(self._folder.parent / part)
            _remove(self.path(later))

    def _stored(self, name: str) -> str | None:
        try:
            return json.loads((self.path(name) / MARK).read_text(encoding="utf-8"))["fingerprint"]
        except (FileNotFoundError, ValueError):
            return None


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
