"""What the labels of drawing programs mean: which name lane boundaries, edges of the road, or nothing of interest.

Without a map of the user's, the words of a label decide: `lane`, `line`, `solid_white` and `kerb` name boundaries,
`stop_line`, `crosswalk` and `car` don't.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final, Literal, Self, get_args

from pydantic import ValidationError, model_validator

from lanestream.errors import SettingsError
from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES
from lanestream_exporter.datasets.entries import LabeledLook, boundary_type
from lanestream_exporter.datasets.labels import ROAD_EDGE_TYPES
from lanestream_exporter.toml_files import Section

Meaning = Literal["lane", "road_edge", "ignore"]
MEANINGS: Final[tuple[Meaning, ...]] = get_args(Meaning)

_BOUNDARY_WORDS: Final = frozenset(
    {"line", "lines", "marking", "markings", "boundary", "boundaries", "border", "divider", "separator"}
    | {"centerline", "centreline", "edgeline", "roadline"}
)
_BOUNDARY_START: Final = "lane"  # also of lanes, laneline and lanemarking
# Words that rule out a boundary, even beside a word like lane or line.
_OTHER_WORDS: Final = frozenset(
    {"area", "region", "drivable", "surface", "stop", "crosswalk", "crosswalks", "crossing", "zebra", "arrow", "arrows"}
    | {"stopline", "ignore", "ignored", "horizon", "hood", "bonnet"}
)
# A line may be named only by these, and by numbers.
_LINE_WORDS: Final = frozenset(
    {"left", "right", "ego", "center", "centre", "middle", "inner", "outer", "l", "r", "polyline", "linestrip"}
    | {"painted", *MARKING_COLORS}
)
_SEPARATORS: Final = re.compile(r"[\s_-]+")


class LabelMap(Section):
    """The labels that mean a lane boundary, an edge of the road, or something to ignore.

    A whole label is compared, without regard to case, spaces, hyphens and underscores. All other labels mean what their
    words say, see `meaning`. An edge of the road has the type `edge`, unless its label or attributes say `kerb`.
    """

    lane: tuple[str, ...] = ()
    road_edge: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [_normal(label) for label in (*self.lane, *self.road_edge, *self.ignore)]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise ValueError(f"the label {repeated!r} is listed twice; list each label once")
        return self

    @classmethod
    def of(cls, pairs: Iterable[str]) -> LabelMap:
        """Returns the map of `LABEL=MEANING` pairs. Raises SettingsError if one is malformed."""
        labels: dict[str, list[str]] = {meaning: [] for meaning in MEANINGS}
        for pair in pairs:
            label, separator, meaning = pair.rpartition("=")
            if not separator or not label or meaning not in labels:
                raise SettingsError(f"{pair!r} doesn't map a label", f"give LABEL={'|'.join(MEANINGS)}")
            labels[meaning].append(label)
        try:
            return cls.model_validate(labels)
        except ValidationError as error:
            raise SettingsError(str(error.errors()[0]["ctx"]["error"])) from None

    def meaning(self, label: str) -> Meaning | None:
        """Returns what a label means; None if neither the map nor its words say."""
        given = self._given(label)
        if given is not None:
            return given
        words = words_of(label)
        if not _OTHER_WORDS.isdisjoint(words):
            return "ignore"
        return "lane" if any(map(_names_boundary, words)) else None

    def meaning_of_line(self, label: str) -> Meaning | None:
        """Returns what the label of a drawn line means, which may also say only where or of what color the line is."""
        says_where = label.isascii() and _LINE_WORDS.issuperset(words_of(label))
        return self.meaning(label) or ("lane" if says_where else None)

    def look(self, label: str, types: Iterable[str] = (), colors: Iterable[str] = ()) -> LabeledLook:
        """Returns how a boundary looks, by its label and by the lower-case words of its attributes, which go first.

        The type of a marking does not fit a label like `road_edge`: it was left over when the label was changed.
        """
        words = self._look_words(label)
        names_edge = any(map(_is_edge, words)) and not any(map(_is_line, words))
        fitting = [word for word in types if not names_edge or boundary_type(word) not in MARKING_TYPES]
        return LabeledLook.of([*fitting, *words], [*colors, *words])

    def _look_words(self, label: str) -> list[str]:
        """Returns the words of a label that describe how the boundary looks."""
        words = words_of(label)
        match self._given(label):
            case "lane":
                return [word for word in words if not _is_edge(word)]
            case "road_edge":
                return ["kerb" if "kerb" in map(boundary_type, words) else "edge"]
            case _:
                return words

    def _given(self, label: str) -> Meaning | None:
        name = _normal(label)
        given: tuple[tuple[Meaning, tuple[str, ...]], ...] = (
            ("lane", self.lane),
            ("road_edge", self.road_edge),
            ("ignore", self.ignore),
        )
        return next((meaning for meaning, labels in given if name in map(_normal, labels)), None)


BY_WORDS: Final = LabelMap()


def words_of(label: str) -> list[str]:
    """Returns the ASCII words of a label in lower case: solid and white of `solid_white` and of `SolidWhite`."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", label)]


def _names_boundary(word: str) -> bool:
    return _is_line(word) or boundary_type(word) is not None


def _is_line(word: str) -> bool:
    return word.startswith(_BOUNDARY_START) or word in _BOUNDARY_WORDS


def _is_edge(word: str) -> bool:
    return boundary_type(word) in ROAD_EDGE_TYPES


def _normal(label: str) -> str:
    return _SEPARATORS.sub(" ", label.strip().casefold())
