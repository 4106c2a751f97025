"""The ROS node: parameters, subscriptions, publishers and diagnostics around the bridge."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import asdict
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Point32
from lanestream_msgs.msg import Lane, Lanes
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from visualization_msgs.msg import Marker, MarkerArray

from lanestream.errors import LanestreamError
from lanestream_bridge.bridge import Bridge, BridgeSettings
from lanestream_bridge.conversion import (
    ConversionError,
    MessageTypes,
    camera_of_info,
    camera_of_parameters,
    frame_of_compressed_image,
    frame_of_image,
    lanes_message,
    markers_message,
)
from lanestream_client import CameraModel

TYPES = MessageTypes(Lanes, Lane, Point32, Point, Marker, MarkerArray)
DEFAULTS: dict[str, Any] = {
    "url": "http://127.0.0.1:8000",
    "api_key": "",
    "image_transport": "raw",
    "mode": "latest",
    "detector": "",
    "camera_height": 0.0,
    "field_of_view": 0.0,
    "rectified": False,
    "camera_pitch": "auto",
    "ground_frame": "lanestream_ground",
}


class BridgeNode(Node):
    """Subscribes to `image` (or `image/compressed`) and `camera_info`; publishes `lanes`, `markers`, /diagnostics."""

    def __init__(self) -> None:
        super().__init__("lanestream_bridge")
        self._parameters_given = {name: self.declare_parameter(name, value).value for name, value in DEFAULTS.items()}
        given = self._parameters_given
        self._bridge: Bridge | None = None
        self._lanes = self.create_publisher(Lanes, "lanes", 10)
        self._markers = self.create_publisher(MarkerArray, "markers", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        if given["image_transport"] == "compressed":
            self.create_subscription(
                CompressedImage, "image/compressed", self._on_compressed_image, qos_profile_sensor_data
            )
        else:
            self.create_subscription(Image, "image", self._on_image, qos_profile_sensor_data)
        self.create_timer(1.0, self._publish_diagnostics)
        if given["camera_height"] > 0.0 and given["field_of_view"] <= 0.0:
            self._info = self.create_subscription(CameraInfo, "camera_info", self._on_info, qos_profile_sensor_data)
        elif given["field_of_view"] > 0.0:
            self._start(camera_of_parameters(given["camera_height"], given["field_of_view"], given["camera_pitch"]))
        else:
            self._start(None)

    def close(self) -> None:
        """Ends the stream."""
        if self._bridge is not None:
            self._bridge.close()

    def _start(self, camera: CameraModel | None) -> None:
        settings = BridgeSettings.of(self._parameters_given, os.environ, camera, self.get_name())
        self._bridge = Bridge(settings, self._publish)
        self._bridge.start()

    def _on_info(self, message: CameraInfo) -> None:
        given = self._parameters_given
        if self._bridge is not None:
            return
        try:
            camera = camera_of_info(
                message, given["camera_height"], given["camera_pitch"], rectified=given["rectified"]
            )
        except ConversionError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        self.destroy_subscription(self._info)
        self._start(camera)

    def _on_image(self, message: Image) -> None:
        self._send(frame_of_image, message)

    def _on_compressed_image(self, message: CompressedImage) -> None:
        self._send(frame_of_compressed_image, message)

    def _send(self, convert: Any, message: Any) -> None:
        if self._bridge is None:
            self.get_logger().info("waiting for camera_info", throttle_duration_sec=10.0)
            return
        try:
            self._bridge.send(convert, message)
        except ConversionError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)

    def _publish(self, header: Any, lanes: Any) -> None:
        frame = self._parameters_given["ground_frame"]
        self._lanes.publish(lanes_message(lanes, header, frame, TYPES))
        self._markers.publish(markers_message(lanes, header.stamp, frame, TYPES))

    def _publish_diagnostics(self) -> None:
        status = None if self._bridge is None else self._bridge.status
        entry = DiagnosticStatus(name=f"{self.get_name()}: stream", hardware_id=self._parameters_given["url"])
        if status is None:
            entry.level, entry.message = DiagnosticStatus.WARN, "waiting for camera_info"
        else:
            level, entry.message = status.diagnosis(time.monotonic())
            entry.level = getattr(DiagnosticStatus, level)
            entry.values = [KeyValue(key=key, value=str(value)) for key, value in asdict(status).items()]
        message = DiagnosticArray(status=[entry])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def main() -> None:
    """Runs the node until it is interrupted."""
    rclpy.init()
    try:
        node = BridgeNode()
    except (ConversionError, LanestreamError) as error:
        sys.exit(f"error: {error}")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()
