"""The service over HTTP and WebSockets."""

from lanestream.api.app import create_app

__all__ = ["create_app"]
