"""The installed function that draws lanes on images, found by its entry point: the service must not import it."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from lanestream.api.service import DrawLanes

# An entry point of this group is a function that draws a `lanes` message on an image.
_GROUP: Final = "lanestream.overlays"


def installed_overlay() -> DrawLanes | None:
    """Returns the installed function, or None if it is missing."""
    for entry_point in entry_points(group=_GROUP):
        draw: DrawLanes = entry_point.load()
        return draw
    return None
