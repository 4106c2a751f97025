"""Split rules: which labeled frames train, which validate, and which are only reported on.

Neighboring frames look alike. A drive or clip in two splits would test a network on what it memorized, so frames are
divided by drive, and the rules that cut a drive say so explicitly.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Annotated, Any, Final, Literal, Self, get_args

import numpy as np
from pydantic import BeforeValidator, Field, NonNegativeInt, model_validator

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import LabelEntry
from lanestream_exporter.toml_files import Section

Split = Literal["train", "val", "test"]
SPLITS: Final[tuple[Split, ...]] = get_args(Split)

# Longer than any video.
_WHOLE_VIDEO: Final = range(1_000_000)

FrameRange = tuple[NonNegativeInt, NonNegativeInt]


class WholeSplit(Section):
    """The whole data set is in one split. In the file: `split = "train"`."""

    by: Literal["whole"]
    split: Split


class RecordSplit(Section):
    """Each record of the label file has a field `split`."""

    by: Literal["record"]


class FrameSplit(Section):
    """The videos are cut by frame numbers: from the first of a range up to, but not including, the second.

    `field` names a field of the records that numbers the frames; without it, they have their numbers in the video.
    """

    by: Literal["frame"]
    field: str | None = None
    train: FrameRange | None = None
    val: FrameRange | None = None
    test: FrameRange | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        ranges = sorted((part for part in map(self.range_of, SPLITS) if part), key=lambda part: part.start)
        if not ranges:
            raise ValueError("none of train, val and test has frames; give a range such as train = [0, 2000]")
        if any(before.stop > after.start for before, after in pairwise(ranges)):
            raise ValueError("the ranges of train, val and test overlap")
        return self

    def range_of(self, split: Split) -> range:
        """Returns the frames of a split, empty if it has none."""
        first, end = getattr(self, split) or (0, 0)
        return range(first, end)


class GroupSplit(Section):
    """Whole drives, drawn with `seed`, validate: about the share `val` of all frames. The others train."""

    by: Literal["group"]
    val: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.2
    seed: NonNegativeInt = 0


class NamedSplit(Section):
    """The drives or clips that `val` names validate. The others train."""

    by: Literal["name"]
    val: Annotated[tuple[str, ...], Field(min_length=1)]


def _whole(value: Any) -> Any:
    """Returns the table that `split = "train"` stands for."""
    if not isinstance(value, str):
        return value
    if value not in SPLITS:
        raise ValueError(f"{value!r} is not a split; accepted are {', '.join(SPLITS)}, or a table with the key `by`")
    return {"by": "whole", "split": value}


SplitRule = WholeSplit | RecordSplit | FrameSplit | GroupSplit | NamedSplit
SplitField = Annotated[Annotated[SplitRule, Field(discriminator="by")], BeforeValidator(_whole)]


def split_of(rule: SplitRule, entry: LabelEntry, validation_groups: frozenset[str]) -> Split | None:
    """Returns the split of an entry, None if it is in none; `validation_groups` are those of `validation_groups_of`.

    Raises LabelError if the labels lack what the rule needs.
    """
    if isinstance(rule, WholeSplit):
        return rule.split
    if isinstance(rule, GroupSplit | NamedSplit):
        return "val" if entry.group in validation_groups else "train"
    if isinstance(rule, RecordSplit):
        if entry.split not in SPLITS:
            found = "the record has no split" if entry.split is None else f"{entry.split!r} is not a split"
            raise LabelError(
                f"{entry.location}: {found}",
                f"a field `split` with {', '.join(SPLITS)} is accepted, or another split rule in the manifest",
            )
        return entry.split
    number = entry.index if rule.field is None else entry.fields.get(rule.field)
    if not isinstance(number, int):
        missing = "frame number" if rule.field is None else f"number {rule.field!r}"
        raise LabelError(
            f"{entry.location}: {entry.source} has no {missing}", "frames can only be split by number if labels give it"
        )
    return next((split for split in SPLITS if number in rule.range_of(split)), None)


def validation_groups_of(rule: SplitRule, groups: Iterable[str]) -> frozenset[str]:
    """Returns the drives or clips that a rule validates with, of `groups`, which has that of every frame.

    Raises LabelError if the rule names one that isn't there, or if there are too few to draw from.
    """
    if isinstance(rule, GroupSplit):
        return split_by_group(groups, rule.val, rule.seed).validation
    if not isinstance(rule, NamedSplit):
        return frozenset()
    found = set(groups)
    missing = [name for name in rule.val if name not in found]
    if missing:
        raise LabelError(f"there is no drive or clip {missing[0]!r}", f"found are {', '.join(sorted(found))}")
    return frozenset(rule.val)


def clip_frames(rule: SplitRule, split: Split, labeled: Sequence[int]) -> range:
    """Returns the frames of a video that belong to `split`; `labeled` are the indices of its labeled frames there."""
    if isinstance(rule, FrameSplit):
        return rule.range_of(split)
    if isinstance(rule, RecordSplit):
        return range(min(labeled), max(labeled) + 1)
    return _WHOLE_VIDEO


@dataclass(frozen=True)
class GroupDivision:
    """The drives or clips that are trained on, and those that validate."""

    train: frozenset[str]
    validation: frozenset[str]


def split_by_group(groups: Iterable[str], validation_share: float, seed: int = 0) -> GroupDivision:
    """Divides frames by drive or clip; `groups` has the group of every frame, in any order.

    Whole groups, in an order drawn with `seed`, go to validation until their frames come closest to
    `validation_share` (0 to 1) of all. Each side gets at least one group. The result is reproducible.
    Raises LabelError for fewer than two groups.
    """
    sizes = Counter(groups)
    if len(sizes) < 2:
        raise LabelError(
            f"{len(sizes)} drive or clip can't be split by drive",
            "frames of at least two are needed: put each into a folder of its own",
        )
    wanted = validation_share * sizes.total()
    names = sorted(sizes)
    order = [names[number] for number in np.random.default_rng(seed).permutation(len(names))]
    validation: set[str] = set()
    taken = 0
    for name in order:
        if taken + sizes[name] <= wanted:
            validation.add(name)
            taken += sizes[name]
    # One more group if slightly too many frames are closer to the share than slightly too few.
    left = [name for name in order if name not in validation]
    if left and abs(taken + (least := min(sizes[name] for name in left)) - wanted) < wanted - taken:
        validation.add(next(name for name in left if sizes[name] == least))
    if not validation:
        validation.add(min(order, key=lambda name: sizes[name]))
    if len(validation) == len(names):
        validation.remove(max(order, key=lambda name: sizes[name]))
    return GroupDivision(frozenset(names) - validation, frozenset(validation))


def refuse_leak(train: Iterable[str], validation: Iterable[str], test: Iterable[str] = ()) -> None:
    """Raises LabelError if a drive or clip is in more than one part; each part has the groups of its frames."""
    parts = {"train": set(train), "validation": set(validation), "test": set(test)}
    for (one, left), (other, right) in combinations(parts.items(), 2):
        if shared := sorted(left & right):
            more = f" and {len(shared) - 1} more" if len(shared) > 1 else ""
            raise LabelError(
                f"{shared[0]!r}{more} is in both {one} and {other}",
                "put each drive or clip on one side of a split only",
            )
