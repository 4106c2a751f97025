"""Checks a data set: counts what it holds and finds every record that is wrong."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, field

from lanestream.errors import LabelError
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.datasets.reading import LabeledSample
from lanestream_exporter.datasets.splits import refuse_leak


@dataclass
class DatasetContents:
    """Counts over the sound frames of a data set. `rows` go from the highest to the lowest labeled point."""

    groups: Counter[str] = field(default_factory=Counter)
    sizes: Counter[tuple[int, int]] = field(default_factory=Counter)
    lanes: Counter[int] = field(default_factory=Counter)
    kinds: Counter[str] = field(default_factory=Counter)
    types: Counter[str] = field(default_factory=Counter)
    colors: Counter[str] = field(default_factory=Counter)
    positions: Counter[int] = field(default_factory=Counter)
    splits: Counter[str] = field(default_factory=Counter)
    converted: Counter[str] = field(default_factory=Counter)
    others: Counter[str] = field(default_factory=Counter)
    rows: tuple[float, float] | None = None

    def add(self, frame: LabeledFrame) -> None:
        """Counts a frame."""
        self.groups[frame.group] += 1
        self.sizes[frame.width, frame.height] += 1
        self.lanes[len(frame.lanes)] += 1
        self.kinds.update(lane.kind or "unknown" for lane in frame.lanes)
        self.types.update(lane.type for lane in frame.lanes if lane.type)
        self.colors.update(lane.color for lane in frame.lanes if lane.color)
        self.positions.update(lane.position for lane in frame.lanes if lane.position is not None)
        rows = [float(y) for lane in frame.lanes for y in (lane.points[0, 1], lane.points[-1, 1])]
        rows += self.rows or ()
        self.rows = (min(rows), max(rows)) if rows else None

    def lines(self) -> list[str]:
        """Returns a summary, one line per kind of content."""
        common = ", ".join(f"{name} ({count})" for name, count in self.groups.most_common(5))
        summaries = [
            ("groups", f"{len(self.groups)}: {common}{', ...' if len(self.groups) > 5 else ''}"),
            ("splits", _counts(self.splits)),
            ("lanes per frame", _counts(self.lanes)),
            ("image sizes", ", ".join(f"{w} x {h}: {count}" for (w, h), count in self.sizes.most_common())),
            ("rows covered", f"{self.rows[0]:g} to {self.rows[1]:g}" if self.rows else "none"),
            ("positions", _counts(self.positions)),
            ("kinds", _counts(self.kinds)),
            ("types", _counts(self.types)),
            ("colors", _counts(self.colors)),
            ("converted shapes", _counts(self.converted)),
            ("ignored shapes", _counts(self.others)),
        ]
        return [f"frames: {self.groups.total()}", *(f"{name}: {text}" for name, text in summaries if text)]


def _counts(counter: Counter[int] | Counter[str]) -> str:
    """Returns `value: count` pairs, numbers in ascending order and words by frequency."""
    pairs = sorted(counter.items()) if all(isinstance(key, int) for key in counter) else counter.most_common()
    return ", ".join(f"{key}: {count}" for key, count in pairs)


@dataclass(frozen=True)
class _FirstUse:
    """Where an image was used first."""

    location: str
    group: str


class DatasetCheck:
    """Collects what `scan_dataset` yields: counts of sound frames, and all faults.

    Besides faults of single records it finds frames that are labeled twice, and files with the same image: in two
    groups they would leak through a split. Equal frames of a video, in which the vehicle stands still, are not a fault.
    """

    def __init__(self) -> None:
        self.contents = DatasetContents()
        self.faults: list[LabelError] = []
        self._locations: dict[tuple[str, str], str] = {}
        self._images: dict[bytes, _FirstUse] = {}

    def add(self, found: LabeledSample | LabelError) -> None:
        """Adds one record."""
        if isinstance(found, LabelError):
            self.faults.append(found)
            return
        self.contents.add(found.frame)
        self.contents.converted.update(found.entry.converted)
        self.contents.others.update(found.entry.others)
        self.contents.splits.update([found.entry.split] if found.entry.split else [])
        self._find_duplicate(found)

    def _find_duplicate(self, sample: LabeledSample) -> None:
        location, source, group = sample.entry.location, sample.frame.source, sample.frame.group
        if (group, source) in self._locations:
            first = self._locations[group, source]
            self.faults.append(LabelError(f"{location}: {source} is labeled a second time, after {first}"))
            return
        self._locations[group, source] = location
        used = self._images.setdefault(_digest(sample), _FirstUse(location, group))
        if used.group != group:
            self.faults.append(
                LabelError(
                    f"{location}: {source} has the image of {used.location}, "
                    f"but its group is {group!r}, not {used.group!r}"
                )
            )
        elif used.location != location and sample.entry.image.index is None:
            self.faults.append(LabelError(f"{location}: {source} has the same image as {used.location}"))

    def leaks(self, other: DatasetCheck) -> list[LabelError]:
        """Returns what this data set shares with the `other` side of a split: groups, and images in other groups."""
        faults = []
        try:
            refuse_leak(self.contents.groups, other.contents.groups)
        except LabelError as error:
            faults.append(error)
        shared_groups = self.contents.groups.keys() & other.contents.groups.keys()
        for digest in self._images.keys() & other._images.keys():
            mine, theirs = self._images[digest], other._images[digest]
            if mine.group not in shared_groups:
                faults.append(LabelError(f"{mine.location}: its image is on the other side too, at {theirs.location}"))
        return sorted(faults, key=str)


def _digest(sample: LabeledSample) -> bytes:
    height, width = sample.image.shape[:2]
    return hashlib.blake2b(sample.image.tobytes(), digest_size=16, salt=b"%d,%d" % (width, height)).digest()
