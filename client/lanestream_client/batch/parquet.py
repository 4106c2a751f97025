"""The results as two Parquet tables: one row per frame, and one row per lane boundary of a frame.

docs/batch.md describes the columns. Names are those of the messages, see `lanestream.protocol`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import IO, TYPE_CHECKING, Any, Final

from lanestream.errors import needs_extra

if TYPE_CHECKING:
    from lanestream.protocol import LaneModel, LanesMessage
    from lanestream_client.frames import StreamResult

# One row group; a long video is not kept in memory.
_FRAMES_PER_GROUP: Final = 2000
Row = dict[str, Any]


class ParquetTables:
    """Writes the tables `frames` and `lanes` of one unit. Raises MissingExtraError without pyarrow."""

    def __init__(self, create: Callable[[str, str], IO[bytes]]) -> None:
        with needs_extra("batch"):
            import pyarrow.parquet
        frames, lanes = frame_schema(), lane_schema()
        self._frames: list[Row] = []
        self._lanes: list[Row] = []
        self._frame_table = pyarrow.parquet.ParquetWriter(create("frames", "parquet"), frames, compression="zstd")
        self._lane_table = pyarrow.parquet.ParquetWriter(create("lanes", "parquet"), lanes, compression="zstd")

    def write(self, path: str, result: StreamResult) -> None:
        """Adds the rows of one frame."""
        file = os.fsencode(path).decode("utf-8", "replace")
        if result.lanes is not None:
            self._frames.append({"file": file, **_frame_row(result.lanes), "clock": result.frame.clock})
            self._lanes += ({"file": file, **_lane_row(result.lanes, lane)} for lane in result.lanes.lanes)
        elif result.error is not None:
            self._frames.append({"file": file, "seq": result.frame.seq, "error": result.error.message})
        if len(self._frames) == _FRAMES_PER_GROUP:
            self._write_group()

    def close(self) -> None:
        """Writes the rows that are left, and the ends of the files."""
        self._write_group()
        self._frame_table.close()
        self._lane_table.close()

    def abandon(self) -> None:
        """Leaves the files without their ends."""
        # Otherwise pyarrow would write them when it frees the writers.
        self._frame_table.is_open = self._lane_table.is_open = False

    def _write_group(self) -> None:
        import pyarrow as pa

        if self._frames:
            self._frame_table.write_table(pa.Table.from_pylist(self._frames, frame_schema()))
        if self._lanes:
            self._lane_table.write_table(pa.Table.from_pylist(self._lanes, lane_schema()))
        self._frames, self._lanes = [], []


def frame_schema() -> Any:
    """Returns the pyarrow schema of the table `frames`."""
    import pyarrow as pa

    text, number, integer = pa.string(), pa.float64(), pa.int64()
    event = pa.struct(
        {
            "type": text,
            "timestamp": number,
            "track_id": integer,
            "direction": text,
            "state": text,
            "side": text,
            "pitch": number,
            "yaw": number,
        }
    )
    ego = ("offset", "offset_m", "lane_width_m", "heading", "curvature", "lateral_speed")
    return pa.schema(
        {
            "file": text,
            "seq": integer,
            "timestamp": number,
            "clock": text,
            "error": text,
            "width": integer,
            "height": integer,
            "horizon": number,
            "lanes": integer,
            "ego_left": integer,
            "ego_right": integer,
            "ego_left_kind": text,
            "ego_right_kind": text,
            **{f"ego_{name}{suffix}": number for name in ego for suffix in ("", "_sigma")},
            "departure_state": text,
            "departure_side": text,
            "camera_pitch": number,
            "camera_yaw": number,
            "camera_settled": pa.bool_(),
            "events": pa.list_(event),
            "total_ms": number,
        }
    )


def lane_schema() -> Any:
    """Returns the pyarrow schema of the table `lanes`."""
    import pyarrow as pa

    text, number, integer = pa.string(), pa.float64(), pa.int64()
    numbers = pa.list_(number)
    return pa.schema(
        {
            "file": text,
            "seq": integer,
            "timestamp": number,
            "track_id": integer,
            "position": integer,
            "state": text,
            "probability": number,
            "age_s": number,
            "kind": text,
            "kind_probability": number,
            "marking_type": text,
            "marking_type_probability": number,
            "marking_color": text,
            "marking_color_probability": number,
            "marking_probability": number,
            "bottom_x": number,
            "bottom_y": number,
            "top_x": number,
            "top_y": number,
            "points_x": numbers,
            "points_y": numbers,
            "horizon": number,
            "v": number,
            "b": number,
            "k": number,
            "covariance": numbers,
            "ground_a": number,
            "ground_b": number,
            "ground_c": number,
            "ground_covariance": numbers,
        }
    )


def _frame_row(lanes: LanesMessage) -> Row:
    message = lanes.model_dump(exclude={"lanes"})
    ego, departure, calibration = message["ego"], message["departure"] or {}, message["calibration"] or {}
    return {
        **{name: message[name] for name in ("seq", "timestamp", "width", "height", "horizon", "events")},
        "lanes": len(lanes.lanes),
        **{f"ego_{name}": value for name, value in ego.items()},
        **{f"departure_{name}": departure.get(name) for name in ("state", "side")},
        **{f"camera_{name}": calibration.get(name) for name in ("pitch", "yaw", "settled")},
        "total_ms": message["timing_ms"]["total"],
    }


def _lane_row(lanes: LanesMessage, lane: LaneModel) -> Row:
    marking, line = lane.marking, lane.line
    v, b, k = lane.coefficients
    ground = lane.ground or (None, None, None)
    return {
        "seq": lanes.seq,
        "timestamp": lanes.timestamp,
        "track_id": lane.track_id,
        "position": lane.position,
        "state": lane.state,
        "probability": lane.probability,
        "age_s": lane.age_s,
        "kind": lane.kind,
        "kind_probability": lane.kind_probability,
        "marking_type": marking and marking.type,
        "marking_type_probability": marking and marking.type_probability,
        "marking_color": marking and marking.color,
        "marking_color_probability": marking and marking.color_probability,
        "marking_probability": marking and marking.probability,
        "bottom_x": line.bottom[0],
        "bottom_y": line.bottom[1],
        "top_x": line.top[0],
        "top_y": line.top[1],
        "points_x": [x for x, _ in lane.points],
        "points_y": [y for _, y in lane.points],
        "horizon": lane.horizon,
        "v": v,
        "b": b,
        "k": k,
        "covariance": _flat(lane.covariance),
        **dict(zip(("ground_a", "ground_b", "ground_c"), ground, strict=True)),
        "ground_covariance": None if lane.ground_covariance is None else _flat(lane.ground_covariance),
    }


def _flat(matrix: list[list[float]]) -> list[float]:
    return [value for row in matrix for value in row]
