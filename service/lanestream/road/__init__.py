"""The geometry of a road in an image: curves, views, cameras, and the results in these terms."""
