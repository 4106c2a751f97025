"""The report at the end of a run."""

from __future__ import annotations

from lanestream_client.report import Tally, percentile
from lanestream_client.service import ServiceInfo

from lanestream.protocol import EgoModel, LanesMessage, TimingModel


def test_the_report_counts_and_measures() -> None:
    tally = Tally()
    for number in range(1, 101):
        timing = TimingModel(decode=1, propose=2, queue=0, infer=number, track=0.5, total=number + 3.5)
        ego = EgoModel(left=1, right=2 if number % 2 else None, offset=None)
        tally.answered(
            LanesMessage(
                seq=number,
                timestamp=0,
                width=9,
                height=9,
                horizon=1,
                lanes=[],
                ego=ego,
                events=[],
                dropped=0,
                timing_ms=timing,
            )
        )
    tally.fail()
    report = tally.report(ServiceInfo("m 1", "cpu"), dropped=4)
    assert report.startswith("105 frames: 100 answered, 4 dropped, 1 failed; ")
    assert "both ego boundaries in 50.0 %" in report
    assert "infer       50.00    95.00" in report
    assert report.endswith("model m 1 on cpu")
    assert "ms" not in Tally().report(ServiceInfo("m 1", "cpu")).split()


def test_percentiles_are_values_that_occurred() -> None:
    assert [percentile([1.0, 2.0, 3.0, 4.0], share) for share in (0, 25, 50, 95, 100)] == [1.0, 1.0, 2.0, 4.0, 4.0]
