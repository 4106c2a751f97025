"""Pictures that show no road: pages, walls, rooms, landscapes, faces. A detector must find nothing in them.

Many are hard on purpose: floors of planks, corridors, keyboards and rails show bright bars that meet at one point, as
lane lines do. None shows a carriageway, a path or a parking lot: even unmarked ones have edges that are boundaries.

`pictures.py` has the kinds of pictures; `rooms.py`, `outdoors.py`, `close_ups.py` and `flat.py` draw them, from the
patterns of `patterns.py` and `prints.py`.
"""

from lanestream_exporter.scenes.no_road.pictures import KINDS, Kind, sample_kind_and_picture, sample_picture

__all__ = ["KINDS", "Kind", "sample_kind_and_picture", "sample_picture"]
