"""Training samples: patches, road crops, their augmentation and the cache they are kept in."""
