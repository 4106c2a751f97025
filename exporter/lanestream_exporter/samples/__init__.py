"""Training samples: patches, road crops, their augmentation, and the files they are cached in."""
