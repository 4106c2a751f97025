"""The colors of overlays, as blue, green, red from 0 to 255."""

from __future__ import annotations

from typing import Final

Color = tuple[int, int, int]

# After Okabe and Ito: people with color blindness can distinguish them, too. None is the yellow of yellow paint.
POSITIONS: Final[dict[int, tuple[Color, str]]] = {
    -2: ((200, 120, 225), "next left"),
    -1: ((40, 165, 255), "ego left"),
    1: ((255, 190, 70), "ego right"),
    2: ((150, 225, 60), "next right"),
}
_OTHER: Final[tuple[Color, str]] = ((190, 190, 190), "further out")
WHITE: Final[Color] = (245, 245, 245)
DARK: Final[Color] = (28, 24, 20)
GRAY: Final[Color] = (150, 150, 150)
ALERT: Final[Color] = (70, 70, 235)
CAUTION: Final[Color] = (40, 200, 250)
YELLOW: Final[Color] = (0, 235, 255)
EGO_LANE: Final[Color] = (150, 220, 60)


def position_color(position: int) -> Color:
    """Returns the color of the boundaries at a position."""
    return POSITIONS.get(position, _OTHER)[0]


def position_name(position: int) -> str:
    """Returns the name of a position."""
    return POSITIONS.get(position, _OTHER)[1]


def faded(color: Color, strength: float) -> Color:
    """Returns a color on a dark background; `strength` is its share, from 0 to 1."""
    blue, green, red = (round(strength * c + (1.0 - strength) * dark) for c, dark in zip(color, DARK, strict=True))
    return blue, green, red
