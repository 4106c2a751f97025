"""Sends a camera's images to a Lanestream service and publishes the lane boundaries in them."""
