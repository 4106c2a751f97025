"""The bridge to ROS 2 against real services: headers, slow services, refusals, and services that come later."""

from __future__ import annotations

import threading
from array import array
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import cv2
import fakes
import numpy as np
import pytest
from lanestream_bridge.bridge import Bridge, BridgeSettings, BridgeStatus
from lanestream_bridge.conversion import (
    MessageTypes,
    camera_of_parameters,
    frame_of_compressed_image,
    frame_of_image,
    lanes_message,
    markers_message,
)
from rosmessages import message
from scripted import refused_url
from tcpproxy import tcp_proxy

from lanestream.keys import new_key
from lanestream.protocol import LanesMessage

TYPES = MessageTypes(*map(message, ("Lanes", "Lane", "Point32", "Point", "Marker", "MarkerArray")))


class Published:
    """What a bridge has published; `wait_for` waits for it to satisfy a condition."""

    def __init__(self) -> None:
        self.results: list[tuple[Any, LanesMessage]] = []
        self._changed = threading.Condition()

    def publish(self, header: Any, lanes: LanesMessage) -> None:
        with self._changed:
            self.results.append((header, lanes))
            self._changed.notify()

    def wait_for(self, count: int) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.results) >= count, fakes.WAIT_S)


@contextmanager
def running(settings: BridgeSettings, published: Published) -> Iterator[Bridge]:
    bridge = Bridge(settings, published.publish, retry_pause_s=0.05)
    bridge.start()
    try:
        yield bridge
    finally:
        bridge.close()


def header(number: int) -> Any:
    stamp = message("Time")(sec=100 + number // 25, nanosec=40_000_000 * (number % 25))
    return message("Header")(stamp=stamp, frame_id=f"camera_{number}")


def compressed(number: int, file: bytes) -> Any:
    return message("CompressedImage")(header=header(number), format="jpeg", data=array("B", file))


def wait_for_status(bridge: Bridge, condition: Callable[[BridgeStatus], bool]) -> BridgeStatus:
    for _ in range(int(fakes.WAIT_S / 0.02)):
        if condition(bridge.status):
            return bridge.status
        fakes.pause(0.02)
    raise AssertionError(f"the status stays {bridge.status}")


def test_lanes_are_published_with_the_header_of_their_image(real_url: str, road: bytes) -> None:
    pixels = cv2.imdecode(np.frombuffer(road, np.uint8), cv2.IMREAD_COLOR)
    height, width = pixels.shape[:2]
    data = array("B", pixels[:, :, ::-1].tobytes())
    camera = camera_of_parameters(1.4, 62.0, "auto")
    published = Published()
    with running(BridgeSettings(real_url, mode="all", camera=camera), published) as bridge:
        for number in range(3):
            image = message("Image")(
                header=header(number), height=height, width=width, encoding="rgb8", step=3 * width, data=data
            )
            bridge.send(frame_of_image, image)
        for number in range(3, 5):
            bridge.send(frame_of_compressed_image, compressed(number, road))
        published.wait_for(5)
        status = bridge.status
    assert [each.frame_id for each, _ in published.results] == [f"camera_{number}" for number in range(5)]
    assert [lanes.timestamp for _, lanes in published.results] == pytest.approx([100.0, 100.04, 100.08, 100.12, 100.16])
    assert (status.received, status.answered, status.failed, status.error) == (5, 5, 0, None)
    assert status.model.startswith("lanestream-alexnet ")
    kept, lanes = published.results[-1]
    made = lanes_message(lanes, kept, "ground", TYPES)
    assert made.header is kept
    by_position = {lane.position: lane for lane in made.lanes}
    # Y is positive to the left.
    assert by_position[-1].ground[2] > 0.5 > -0.5 > by_position[1].ground[2]
    assert made.lane_width == pytest.approx(by_position[-1].ground[2] - by_position[1].ground[2], abs=0.3)
    markers = markers_message(lanes, kept.stamp, "ground", TYPES).markers
    assert len(markers) == 1 + len(made.lanes)


def test_a_slow_service_gets_the_newest_image(serve: Callable[..., str]) -> None:
    model = fakes.GatedModel()
    published = Published()
    with ExitStack() as stack:
        stack.callback(model.let_through, 1000)
        url = serve(fakes.engine(model))
        bridge = stack.enter_context(running(BridgeSettings(url), published))
        bridge.send(frame_of_compressed_image, compressed(0, fakes.image_file()))
        model.wait_for_a_frame()
        for number in range(1, 30):
            bridge.send(frame_of_compressed_image, compressed(number, fakes.image_file()))
        model.let_through(1000)
        wait_for_status(bridge, lambda _: bool(published.results) and published.results[-1][0].frame_id == "camera_29")
        assert bridge.status.received == 30
        assert len(published.results) < 30


def test_a_service_may_come_later(url: str) -> None:
    published = Published()
    later = refused_url()
    with ExitStack() as stack:
        bridge = stack.enter_context(running(BridgeSettings(later), published))
        bridge.send(frame_of_compressed_image, compressed(0, fakes.image_file()))
        status = wait_for_status(bridge, lambda status: status.error is not None)
        assert status.diagnosis(0.0) == ("ERROR", status.error)
        stack.enter_context(tcp_proxy(int(url.rpartition(":")[2]), int(later.rpartition(":")[2])))
        published.wait_for(1)
        wait_for_status(bridge, lambda status: status.error is None)
    assert published.results[0][0].frame_id == "camera_0", "the image has waited"


def test_a_lost_connection_is_restored(url: str) -> None:
    published = Published()
    with ExitStack() as stack:
        proxy = stack.enter_context(tcp_proxy(int(url.rpartition(":")[2])))
        bridge = stack.enter_context(running(BridgeSettings(f"http://127.0.0.1:{proxy.port}", mode="all"), published))
        bridge.send(frame_of_compressed_image, compressed(0, fakes.image_file()))
        published.wait_for(1)
        proxy.cut()
        bridge.send(frame_of_compressed_image, compressed(1, fakes.image_file()))
        published.wait_for(2)
        assert wait_for_status(bridge, lambda status: status.answered == 2).reconnects == 1
    assert [each.frame_id for each, _ in published.results] == ["camera_0", "camera_1"]


def test_a_service_that_refuses_the_key_is_asked_again(serve: Callable[..., str]) -> None:
    published = Published()
    url = serve(fakes.engine(), api_keys=[str(new_key("camera")[1])])
    with running(BridgeSettings(url, api_key="lane_wrong"), published) as bridge:
        bridge.send(frame_of_compressed_image, compressed(0, fakes.image_file()))
        status = wait_for_status(bridge, lambda status: status.error is not None)
        assert "key" in str(status.error)
        assert "lane_wrong" not in str(status)
    assert published.results == []


def test_a_bad_image_does_not_end_the_stream(url: str) -> None:
    published = Published()
    with running(BridgeSettings(url, mode="all"), published) as bridge:
        bridge.send(frame_of_compressed_image, compressed(0, fakes.image_file()[:30]))
        bridge.send(frame_of_compressed_image, compressed(1, fakes.image_file()))
        published.wait_for(1)
        status = bridge.status
    assert published.results[0][0].frame_id == "camera_1"
    assert (status.answered, status.failed) == (1, 1)
