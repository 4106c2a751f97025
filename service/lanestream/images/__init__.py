"""Image files: their headers, limits and decoding."""
