"""The command `batch`: finds the lanes in archives of videos and images, on all processors or on a Ray cluster."""
