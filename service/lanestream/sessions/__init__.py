"""What is kept between the frames of one camera."""

from lanestream.sessions.session import Session

__all__ = ["Session"]
