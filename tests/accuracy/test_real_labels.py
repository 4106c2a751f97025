"""The labels of the real frames that figures are measured on are all read and have no faults."""

from __future__ import annotations

from pathlib import Path

from labelfiles import check_dataset


def test_the_real_labels_are_sound(data: Path) -> None:
    tusimple = check_dataset(data / "tusimple")
    assert tusimple.faults == []
    assert tusimple.contents.groups == {"tusimple 0313-1": 171}
    assert tusimple.contents.lanes == {3: 26, 4: 145}
    clip = check_dataset(data / "udacity" / "labels" / "highway_concrete.jsonl")
    assert clip.faults == []
    assert clip.contents.groups == {"highway_concrete": 12}
    assert clip.contents.sizes == {(1280, 720): 12}
    for name, frames, types in (
        ("brazil_dnit", 1089, {"solid", "dashed", "double"}),
        ("lums_campus", 145, {"kerb", "edge"}),
        ("moscow_city", 92, {"solid", "dashed", "double", "kerb", "edge"}),
    ):
        wider = check_dataset(data / name)
        assert wider.faults == []
        assert sum(wider.contents.groups.values()) == frames
        assert types <= set(wider.contents.types)
