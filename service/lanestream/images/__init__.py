"""Image files: checks before decoding, and decoding."""
