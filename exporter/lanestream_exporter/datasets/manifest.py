"""The data set manifest: a TOML file that lists labeled data sets, how each is split and what its labels cover.

`configs/datasets.toml` lists this project's own data sets and is the example to follow. Paths in a manifest count from
the data folder.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, model_validator

from lanestream.errors import LabelError, SettingsError
from lanestream.road.appearance import BoundaryKind
from lanestream_exporter.datasets.entries import FieldValue, LabelEntry
from lanestream_exporter.datasets.files import DataFolder
from lanestream_exporter.datasets.formats import AUTO, FORMATS
from lanestream_exporter.datasets.images import ImageReader, video_size
from lanestream_exporter.datasets.label_map import LabelMap
from lanestream_exporter.datasets.label_propagation import LabelPropagation
from lanestream_exporter.datasets.labels import Coverage, LabeledFrame, LabeledImages, LabeledLane
from lanestream_exporter.datasets.reading import labeled_frame, open_entry, read_entries
from lanestream_exporter.datasets.splits import (
    GroupSplit,
    NamedSplit,
    Split,
    SplitField,
    WholeSplit,
    clip_frames,
    split_of,
    validation_groups_of,
)
from lanestream_exporter.toml_files import CONFIG_FOLDER, Section, Share, read_toml

SHIPPED_MANIFEST: Final = CONFIG_FOLDER / "datasets.toml"
SHIPPED_DATA: Final = Path("../shared/data")
_FETCH: Final = "`lanestream data fetch` shows where it comes from; name its folder with --data or LANESTREAM_DATA"
_SIDES: Final = {"left": -1, "right": 1}
_HORIZON_SHARES: Final = (-0.6, 1.0)  # of the height; the camera looks down if it is negative


class CoverageSection(Section):
    """What the labels cover, as `labels.Coverage` explains it. By default anything may have been left unlabeled."""

    ego: bool = False
    open_sides: tuple[Literal["left", "right"], ...] = ("left", "right")
    edges: bool = False
    markings: bool = True

    @property
    def coverage(self) -> Coverage:
        """The same for labeled frames."""
        return Coverage(self.ego, tuple(sorted(_SIDES[side] for side in self.open_sides)), self.edges, self.markings)


class DatasetSpec(Section):
    """One data set of a manifest: a folder or a label file, its split rule, and whom to credit for it.

    `labels` says what the labels of a drawing program mean, and `default_kind` is that of boundaries without type and
    color. `group` and `horizon` name the field of a record with the drive, and the one with the horizon's row as a
    share of the height. Records with one of the fields `skip` are left out. In records whose fields have one of the
    values in `ignore_colors`, colors are not trusted. `masks` are boxes (left, top, right, bottom) in shares of width
    and height, such as logos; they are painted over in still images.
    """

    name: Annotated[str, Field(min_length=1)]
    path: str
    format: str = AUTO
    split: SplitField
    group: str | None = None
    coverage: CoverageSection = CoverageSection()
    labels: LabelMap = LabelMap()
    default_kind: BoundaryKind | None = None
    horizon: str | None = None
    skip: tuple[str, ...] = ()
    ignore_colors: Annotated[dict[str, tuple[str, ...]], Field(default_factory=dict)]
    masks: tuple[tuple[Share, Share, Share, Share], ...] = ()
    license: str | None = None
    credit: str | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.format != AUTO and self.format not in FORMATS:
            raise ValueError(f"unknown label format {self.format!r}; accepted are {AUTO}, {', '.join(FORMATS)}")
        if any(left >= right or top >= bottom for left, top, right, bottom in self.masks):
            raise ValueError("a box of masks is empty; give left, top, right and bottom")
        return self

    def applied(self, entry: LabelEntry) -> LabelEntry:
        """Returns a record of the data set with what the manifest says about it.

        Raises LabelError if it lacks a field that the manifest names, or if its horizon is not accepted.
        """
        group = entry.group if self.group is None else str(self._field(entry, self.group))
        lanes = {name: self._lane(lane, entry) for name, lane in entry.lanes.items()}
        horizon = None if self.horizon is None else self._horizon(entry, self.horizon)
        coverage = self.coverage.coverage
        return replace(
            entry, group=group, lanes=lanes, dataset=self.name, coverage=coverage, horizon=horizon, masks=self.masks
        )

    def _lane(self, lane: LabeledLane, entry: LabelEntry) -> LabeledLane:
        if any(entry.fields.get(name) in values for name, values in self.ignore_colors.items()):
            lane = replace(lane, color=None, default_kind=lane.kind)
        return replace(lane, default_kind=lane.kind or self.default_kind)

    def _horizon(self, entry: LabelEntry, name: str) -> float:
        value = self._field(entry, name)
        least, most = _HORIZON_SHARES
        if isinstance(value, bool | str) or not least <= value <= most:
            raise LabelError(
                f"{entry.location}: its {name} {value!r} is not accepted",
                f"a share of the height from {least:g} to {most:g} is, negative above the picture",
            )
        return float(value)

    def _field(self, entry: LabelEntry, name: str) -> FieldValue:
        if name not in entry.fields:
            raise LabelError(
                f"{entry.location}: the record has no {name}", f"the manifest names this field for {self.name!r}"
            )
        return entry.fields[name]

    @property
    def credit_record(self) -> dict[str, str]:
        """Name, license and credit, as far as the manifest gives them."""
        fields = {"name": self.name, "license": self.license, "credit": self.credit}
        return {key: value for key, value in fields.items() if value is not None}


class DatasetManifest(Section):
    """All data sets of a manifest, in its order."""

    dataset: Annotated[tuple[DatasetSpec, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [spec.name for spec in self.dataset]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise ValueError(f"two data sets are named {repeated!r}; give each its own name")
        return self


@dataclass(frozen=True)
class LabeledClip:
    """A video with labeled frames, by index, and the stretch of its frames that belongs to a split."""

    name: str
    video: Path
    labeled: dict[int, LabeledFrame]
    frames: range


@dataclass(frozen=True)
class DatasetCollection:
    """The data sets of a manifest in a data folder, with their frames by split.

    `is_shipped` is true for the shipped manifest, whose data sets are public.
    """

    manifest: DatasetManifest
    root: Path
    is_shipped: bool = False

    @classmethod
    def open(cls, manifest: Path | None = None, data: Path | None = None) -> DatasetCollection:
        """Reads the manifest at a path, or the shipped one if it is None.

        The data folder is `data`, else $LANESTREAM_DATA, else the folder of the manifest; of the shipped one
        ../shared/data. Raises SettingsError for a bad manifest. Data sets are opened when they are read.
        """
        path = manifest or SHIPPED_MANIFEST
        read = read_toml(path, DatasetManifest, "give a manifest of data sets, a TOML file")
        root = data_folder(data, SHIPPED_DATA if manifest is None else path.parent)
        return cls(read, root, is_shipped=manifest is None)

    def without(self, names: Collection[str]) -> DatasetCollection:
        """Returns the collection without the data sets of these names. Raises SettingsError for an unknown name."""
        known = [spec.name for spec in self.manifest.dataset]
        for name in names:
            if name not in known:
                raise SettingsError(f"the manifest has no data set {name!r}", f"its data sets are {', '.join(known)}")
        kept = tuple(spec for spec in self.manifest.dataset if spec.name not in names)
        return replace(self, manifest=self.manifest.model_copy(update={"dataset": kept}))

    @property
    def any_present(self) -> bool:
        """Whether the data folder holds at least one of the data sets."""
        return any(map(self._is_present, self.manifest.dataset))

    def frames(self, split: Split) -> LabeledImages:
        """Yields the labeled frames of a split, one data set after another. Raises LabelError for a bad record."""
        with ImageReader() as images:
            for entry in self._entries(split):
                for sample in open_entry(entry, images):
                    if isinstance(sample, LabelError):
                        raise sample
                    yield sample.frame, sample.image

    def training_frames(self, propagation: LabelPropagation | None) -> LabeledImages:
        """Yields the frames of the training split, then those that `propagation` labels between them.

        Raises LabelError for a bad record and SourceError for a video that can't be read.
        """
        yield from self.frames("train")
        if propagation is not None:
            for clip in self.clips("train"):
                yield from propagation.frames(clip.video, clip.labeled)

    def clips(self, split: Split) -> Iterator[LabeledClip]:
        """Yields the videos that have labeled frames in a split. Raises LabelError for a bad record."""
        for spec in self.manifest.dataset:
            videos: dict[Path, dict[int, LabeledFrame]] = {}
            for entry in self._entries_of(spec, split):
                if entry.video is not None and entry.index is not None:
                    size = entry.size or video_size(entry.video)
                    frame, faults = labeled_frame(entry, size)
                    if faults:
                        raise faults[0]
                    videos.setdefault(entry.video, {})[entry.index] = frame
            for video, labeled in videos.items():
                name = next(iter(labeled.values())).group
                yield LabeledClip(name, video, labeled, clip_frames(spec.split, split, list(labeled)))

    def require_splits(self, *splits: Split) -> None:
        """Raises LabelError if a split has no frames."""
        for split in splits:
            if not any(True for _ in self._entries(split)):
                raise LabelError(
                    f"the manifest puts no frames into the split {split!r}",
                    'give a data set with frames for it; { by = "group", val = 0.2 } divides one by drive',
                )

    def credits(self) -> list[dict[str, str]]:
        """Returns name, license and credit of every data set that training or validation may use."""
        return [
            spec.credit_record
            for spec in self.manifest.dataset
            if not (isinstance(spec.split, WholeSplit) and spec.split.split == "test")
        ]

    def fingerprint(self) -> str:
        """Returns a hash that changes with the manifest and with the files of its data sets."""
        digest = hashlib.sha256(self.manifest.model_dump_json().encode())
        for spec in filter(self._is_present, self.manifest.dataset):
            for file in DataFolder.at(self._path(spec)).files:
                status = file.stat()
                digest.update(f"{file} {status.st_size} {status.st_mtime_ns}\n".encode())
        return digest.hexdigest()[:12]

    def _entries(self, split: Split) -> Iterator[LabelEntry]:
        for spec in self.manifest.dataset:
            yield from self._entries_of(spec, split)

    def _entries_of(self, spec: DatasetSpec, split: Split) -> Iterator[LabelEntry]:
        if isinstance(spec.split, WholeSplit) and spec.split.split != split:
            return iter(())  # such a data set may be missing
        groups = self._validation_groups[spec.name]
        return (entry for entry in self._read(spec) if split_of(spec.split, entry, groups) == split)

    def _read(self, spec: DatasetSpec) -> Iterator[LabelEntry]:
        """Yields the records of a data set without opening its images."""
        for entry in read_entries(self._path(spec), spec.format, spec.labels):
            if isinstance(entry, LabelError):
                raise entry
            if not any(name in entry.fields for name in spec.skip):
                yield spec.applied(entry)

    def _is_present(self, spec: DatasetSpec) -> bool:
        return (self.root / spec.path).exists()

    def _path(self, spec: DatasetSpec) -> Path:
        path = self.root / spec.path
        if not self._is_present(spec):
            hint = "give the folder that the manifest's paths count from with --data or LANESTREAM_DATA"
            # The usual folder of the shipped data sets is not one that the user named.
            where = "" if self.root == SHIPPED_DATA else f": there is nothing at {path}"
            raise LabelError(f"the data set {spec.name!r} is missing{where}", _FETCH if self.is_shipped else hint)
        return path

    @cached_property
    def _validation_groups(self) -> dict[str, frozenset[str]]:
        """The groups that each data set's split rule chose to validate with, by the data set's name.

        Raises LabelError if two data sets put the same drive or clip into different splits. Missing data sets are
        skipped here; they are reported when their frames are read.
        """
        chosen: dict[str, frozenset[str]] = {spec.name: frozenset() for spec in self.manifest.dataset}
        parts: dict[str, set[tuple[Split, str]]] = {}  # by group: the splits and data sets that it is in
        for spec in filter(self._is_present, self.manifest.dataset):
            if isinstance(spec.split, GroupSplit | NamedSplit):
                chosen[spec.name] = validation_groups_of(spec.split, (entry.group for entry in self._read(spec)))
            for entry in self._read(spec):
                split = split_of(spec.split, entry, chosen[spec.name])
                if split is not None:
                    parts.setdefault(entry.group, set()).add((split, spec.name))
        for group, where in parts.items():
            for (one, first), (other, second) in combinations(sorted(where), 2):
                if one != other and first != second:
                    raise LabelError(
                        f"{group!r} is in {one} by {first!r} and in {other} by {second!r}",
                        "put each drive or clip into one split only",
                    )
        return chosen


def data_folder(given: Path | None, default: Path = SHIPPED_DATA) -> Path:
    """Returns the folder that data sets are in: the `given` one, else $LANESTREAM_DATA, else the `default`."""
    named = given or os.environ.get("LANESTREAM_DATA")
    return Path(named) if named else default


def origin_of(collection: DatasetCollection | None, rendered_scenes: int) -> dict[str, Any]:
    """Returns what a run records about where its frames came from; `collection` is None without labeled frames."""
    return {"real_frames": [] if collection is None else collection.credits(), "rendered_scenes": rendered_scenes}
