"""Pre-labels: the lanes that the networks find, as files that a labeling program opens for correction."""
