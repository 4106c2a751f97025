"""Looking through a data set: what is in it, and every record that is wrong."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, field

from lanestream.errors import LabelError
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.datasets.reading import Sample
from lanestream_exporter.datasets.splits import refuse_leak


@dataclass
class Contents:
    """What the sound frames of a data set hold, counted; rows are those from the highest to the lowest point."""

    groups: Counter[str] = field(default_factory=Counter)
    sizes: Counter[tuple[int, int]] = field(default_factory=Counter)
    lanes: Counter[int] = field(default_factory=Counter)
    kinds: Counter[str] = field(default_factory=Counter)
    colours: Counter[str] = field(default_factory=Counter)
    positions: Counter[int] = field(default_factory=Counter)
    others: Counter[str] = field(default_factory=Counter)
    rows: tuple[float, float] | None = None

    def add(self, frame: LabelledFrame) -> None:
        """Counts a frame."""
        self.groups[frame.group] += 1
        self.sizes[frame.width, frame.height] += 1
        self.lanes[len(frame.lanes)] += 1
        self.kinds.update(lane.kind for lane in frame.lanes if lane.kind)
        self.colours.update(lane.color for lane in frame.lanes if lane.color)
        self.positions.update(lane.position for lane in frame.lanes if lane.position is not None)
        rows = [float(y) for lane in frame.lanes for y in (lane.points[0, 1], lane.points[-1, 1])]
        rows += self.rows or ()
        self.rows = (min(rows), max(rows)) if rows else None

    def lines(self) -> list[str]:
        """What is there, in words, a line a thing."""
        total = self.groups.total()
        some = ", ".join(f"{name} ({count})" for name, count in self.groups.most_common(5))
        told = [
            ("groups", f"{len(self.groups)}: {some}{', ...' if len(self.groups) > 5 else ''}"),
            ("lanes per frame", _counts(self.lanes)),
            ("image sizes", ", ".join(f"{w} x {h}: {count}" for (w, h), count in self.sizes.most_common())),
            ("rows covered", f"{self.rows[0]:g} to {self.rows[1]:g}" if self.rows else "none"),
            ("positions", _counts(self.positions)),
            ("kinds", _counts(self.kinds)),
            ("colours", _counts(self.colours)),
            ("passed over", _counts(self.others)),
        ]
        return [f"frames: {total}", *(f"{name}: {words}" for name, words in told if words)]


def _counts(counter: Counter[int] | Counter[str]) -> str:
    """`what: how often`, numbers in their order and words by how common they are."""
    pairs = sorted(counter.items()) if all(isinstance(key, int) for key in counter) else counter.most_common()
    return ", ".join(f"{key}: {count}" for key, count in pairs)


@dataclass(frozen=True)
class _Seen:
    """Where a picture was first met."""

    place: str
    group: str


class Check:
    """Takes what `survey` yields of a data set; counts what is sound and keeps all that is wrong.

    Beyond the faults of single records it finds frames that are labelled twice, and files that show the same picture:
    under two groups they would leak through a split. Frames of a video that stand still are no fault.
    """

    def __init__(self) -> None:
        self.contents = Contents()
        self.faults: list[LabelError] = []
        self._places: dict[tuple[str, str], str] = {}
        self._pictures: dict[bytes, _Seen] = {}

    def add(self, found: Sample | LabelError) -> None:
        """Takes one record."""
        if isinstance(found, LabelError):
            self.faults.append(found)
            return
        self.contents.add(found.frame)
        self.contents.others.update(found.entry.others)
        self._look_for_twin(found)

    def _look_for_twin(self, sample: Sample) -> None:
        place, source, group = sample.entry.place, sample.frame.source, sample.frame.group
        if (group, source) in self._places:
            first = self._places[group, source]
            self.faults.append(LabelError(f"{place}: {source} is labelled a second time, after {first}"))
            return
        self._places[group, source] = place
        seen = self._pictures.setdefault(_digest(sample), _Seen(place, group))
        if seen.group != group:
            self.faults.append(
                LabelError(f"{place}: {source} is the picture of {seen.place}, but of {group!r}, not {seen.group!r}")
            )
        elif seen.place != place and sample.entry.picture.index is None:
            self.faults.append(LabelError(f"{place}: {source} is the picture of {seen.place} once more"))

    def leaks(self, other: Check) -> list[LabelError]:
        """What this data set shares with the `other` side of a split: groups, and pictures in groups of other names."""
        faults = []
        try:
            refuse_leak(self.contents.groups, other.contents.groups)
        except LabelError as error:
            faults.append(error)
        shared_groups = self.contents.groups.keys() & other.contents.groups.keys()
        for digest in self._pictures.keys() & other._pictures.keys():
            mine, theirs = self._pictures[digest], other._pictures[digest]
            if mine.group not in shared_groups:
                faults.append(LabelError(f"{mine.place}: its picture is on the other side too, at {theirs.place}"))
        return sorted(faults, key=str)


def _digest(sample: Sample) -> bytes:
    height, width = sample.image.shape[:2]
    return hashlib.blake2b(sample.image.tobytes(), digest_size=16, salt=b"%d,%d" % (width, height)).digest()
