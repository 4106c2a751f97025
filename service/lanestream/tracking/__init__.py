"""Tracking: detections in, boundaries with identities out."""
