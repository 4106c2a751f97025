"""Token buckets: the average rate, the burst, and the bound on the number of names."""

from __future__ import annotations

import pytest

from lanestream.streaming.token_bucket import TokenBucket, TokenBuckets


def test_a_bucket_allows_a_burst_and_then_the_rate() -> None:
    bucket = TokenBucket(10.0, 2.0, now=5.0)
    assert bucket.covers(20.0, 5.0)
    bucket.spend(20.0)
    assert not bucket.covers(1.0, 5.0)
    assert bucket.seconds_until(1.0, 5.0) == pytest.approx(0.1)
    assert bucket.covers(1.0, 5.2)
    assert not bucket.is_full(6.9)
    assert bucket.is_full(7.1)


def test_an_amount_above_the_capacity_needs_a_full_bucket() -> None:
    bucket = TokenBucket(10.0, 2.0, now=0.0)
    assert bucket.covers(1000.0, 0.0)
    bucket.spend(1000.0)
    assert bucket.seconds_until(1000.0, 0.0) == pytest.approx(100.0)


def test_every_name_has_a_bucket_of_its_own() -> None:
    buckets = TokenBuckets(10.0, 1.0)
    buckets.bucket("a", 0.0).spend(10.0)
    assert not buckets.bucket("a", 0.0).covers(1.0, 0.0)
    assert buckets.bucket("b", 0.0).covers(10.0, 0.0)


def test_the_number_of_names_is_bounded_and_those_in_use_are_kept() -> None:
    buckets = TokenBuckets(1.0, 100.0)
    buckets.bucket("busy", 0.0).spend(100.0)
    for number in range(20_000):
        buckets.bucket(f"name {number}", 0.0)
    assert not buckets.bucket("busy", 0.0).covers(1.0, 0.0)
    for number in range(20_000):
        buckets.bucket(f"spent {number}", 0.0).spend(1.0)
    assert len(buckets._buckets) <= 4096
