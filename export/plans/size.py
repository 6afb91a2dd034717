"""How large a fitted plan is: so many terms or poses, or as many as an error needs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Size:
    """One of `count` and `pixels` is given; the text of the whole plan is kept for the file."""

    plan: str
    count: int | None = None
    pixels: float | None = None  # of the scene's nearest camera, the most that a Gaussian may be off

    def __str__(self) -> str:
        return self.plan
