"""Storage of the chosen candidate: its arrays in as few bytes as what plan and pruning left of the error allows."""

from collections.abc import Callable
from dataclasses import replace

import onnx

from export.jobs.job import Candidate, ExportJob
from export.jobs.sweep import ESTIMATE_STRIDE
from export.jobs.write import properties, set_properties
from export.measure.rendered_error import RenderedError
from export.storage.choice import fewest_bytes

PLAN_PART = 0.75
"""Of the squared error that a file may have, the part that plan and pruning may use."""


def stored(job: ExportJob, chosen: Candidate, error: RenderedError, min_psnr: float) -> tuple[Candidate, RenderedError]:
    """The candidate with packed arrays and its error, whose worst frame has at least `min_psnr` dB as the given one
    has; or the given ones if nothing can be packed."""
    contents, tried = onnx.load(chosen.path), list[RenderedError]()
    smaller = replace(chosen, path=job.folder / "stored.onnx")
    on_trial = job.progress("storage in fewer bits", 0)

    def measured(model: onnx.ModelProto, every: int = 1) -> RenderedError:
        smaller.close()
        smaller.path.write_bytes(model.SerializeToString())
        on_trial()
        return job.error(smaller, every)

    def estimate(every: int) -> Callable[[onnx.ModelProto], float]:
        return lambda model: squared(measured(model, every).psnr_worst)

    def is_allowed(model: onnx.ModelProto) -> bool:
        tried.append(measured(model))
        return tried[-1].psnr_worst >= min_psnr

    allowed = squared(min_psnr) - squared(error.psnr_worst)
    found = fewest_bytes(contents, [estimate(ESTIMATE_STRIDE), estimate(1)], is_allowed, allowed)
    if found is None:
        return chosen, error
    saved = contents.ByteSize() - found.contents.ByteSize()
    numbers = {"count": saved, "of": contents.ByteSize(), "bytes_saved": saved, "worst_frame_db": tried[-1].psnr_worst}
    entry = {"rule": "float32", "what": "bytes of arrays in float32", **numbers, "stored": found.kinds}
    set_properties(found.contents, left_out=[*properties(contents)["left_out"], entry])
    smaller.path.write_bytes(found.contents.SerializeToString())
    smaller.close()  # its metadata has changed
    return smaller, tried[-1]


def squared(psnr: float) -> float:
    """Squared error of a frame of this PSNR, dB."""
    return 10 ** (-psnr / 10)
