"""The names that options of commands accept: the keys of tables elsewhere in this package.

Importing those tables imports NumPy or PyTorch; the help of a command must work without them. A test compares both.
"""

from __future__ import annotations

from typing import Final

# The keys of `scenes.scene.STYLES`.
ROAD_STYLES: Final = ("highway", "country", "street", "lane", "campus", "square")
# The keys of `scenes.tracking_clips.KINDS`.
CLIP_KINDS: Final = (
    *("keeping", "lane_change", "curve", "occlusion", "merge", "bump", "cut", "bad_weather", "bad_time"),
    *("clutter", "drift", "long"),
)
# The keys of `datasets.formats.FORMATS`, after its AUTO.
LABEL_FORMATS: Final = ("auto", "tusimple", "culane", "caltech", "labelme", "cvat", "label-studio", "masks", "clips")
# The keys of `labeling.writers.WRITERS`.
PRELABEL_FORMATS: Final = ("cvat", "labelme", "label-studio", "tusimple", "culane")
# `datasets.label_map.MEANINGS`.
LABEL_MEANINGS: Final = ("lane", "road_edge", "ignore")
# The values of `exporting.exportable.Precision`.
PRECISIONS: Final = ("fp32", "fp16", "int8")
# The keys of `exporting.graph.NORMALIZATIONS`.
NORMALIZATIONS: Final = ("contrast", "imagenet")
