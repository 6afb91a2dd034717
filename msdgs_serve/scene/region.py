"""A part of a camera's image."""

from typing import NamedTuple

from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput


class Region(NamedTuple):
    """A rectangle of an image, in pixels from its upper left corner."""

    x: int
    y: int
    width: int
    height: int

    @classmethod
    def whole(cls, camera: Camera) -> "Region":
        """Return the whole image of a camera."""
        return cls(0, 0, camera.width, camera.height)

    @property
    def right(self) -> int:
        return self.x + self.width

    @property
    def bottom(self) -> int:
        return self.y + self.height

    def check(self, camera: Camera) -> None:
        """Raise `InvalidInput` unless this is a part of the camera's image, of at least one pixel."""
        is_whole = all(type(number) is int for number in self)
        is_inside = is_whole and min(self.x, self.y) >= 0 and min(self.width, self.height) >= 1
        if not (is_inside and self.right <= camera.width and self.bottom <= camera.height):
            expected = f"x, y, width and height of a part of the image of {camera.width} × {camera.height} pixels"
            raise InvalidInput("region", expected, list(self))
