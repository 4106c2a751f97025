"""Finding lane boundaries in one frame."""
