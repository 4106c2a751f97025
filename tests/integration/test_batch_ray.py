"""`lanestream batch --ray` on a cluster of three nodes on this machine. Run by `make ray-test`, which installs Ray."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fakes
import pytest
from batches import Batch, rows, write_clip

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    cluster_utils = pytest.importorskip("ray.cluster_utils", reason="needs Ray: use `make ray-test`")

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A cluster with a head and two more nodes, each with one processor."""
    head = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 100 << 20}
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args=head)
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1, object_store_memory=100 << 20)
        yield cluster
    finally:
        cluster.shutdown()


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Thirty videos and four images, one of which is bad."""
    folder = tmp_path / "archive"
    folder.mkdir()
    for number in range(30):
        write_clip(folder / f"{number}.mp4", 40 + number)
    for number in range(3):
        (folder / f"{number}.jpg").write_bytes(fakes.image_file())
    (folder / "bad.jpg").write_bytes(b"not an image")
    return folder


@pytest.fixture
def local(archive: Path, tmp_path: Path) -> dict[tuple[str, int], dict[str, Any]]:
    """The rows of a run without Ray."""
    assert Batch(archive, "--out", tmp_path / "local").finish()[0] == 1
    return rows(tmp_path / "local")


def test_a_cluster_finds_the_same_and_a_node_that_dies_costs_nothing(
    cluster: Any, archive: Path, local: dict[tuple[str, int], dict[str, Any]], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    batch = Batch(archive, "--out", out, "--ray", cluster.address)
    batch.wait_for_files(out, 4)
    cluster.remove_node(cluster.worker_nodes.copy().pop(), allow_graceful=False)
    done = len(list(out.glob("frames/*.jsonl")))
    code, output, errors = batch.finish()
    assert 4 <= done < 31, errors
    assert code == 1, errors
    assert f"failed: {archive / 'bad.jpg'}: not an image: it looks like text" in output
    assert rows(out) == local
    assert not list(out.glob("*/.*"))

    # What is done is not done again, with or without Ray.
    code, _, errors = Batch(archive, "--out", out, "--ray", cluster.address).finish()
    assert (code, "34 of 34 files were processed before" in errors) == (1, True)
    assert Batch(archive, "--out", out).finish()[0] == 1
    assert rows(out) == local


def test_a_batch_on_a_cluster_stops_and_continues(cluster: Any, archive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    batch = Batch(archive, "--out", out, "--ray", cluster.address)
    batch.wait_for_files(out, 3)
    batch.process.terminate()
    code, _, errors = batch.finish()
    assert (code, "stopped; the same command continues" in errors) == (143, True)
    assert 3 <= len(rows(out)) < 30 * 54 + 3
    assert Batch(archive, "--out", out).finish()[0] == 1
    assert len(rows(out)) == sum(40 + number for number in range(30)) + 3


def test_an_address_without_a_cluster_is_reported(archive: Path, tmp_path: Path) -> None:
    code, _, errors = Batch(archive, "--out", tmp_path / "out", "--ray", "127.0.0.1:9").finish()
    assert code == 1
    assert "error: no Ray cluster at 127.0.0.1:9: " in errors
