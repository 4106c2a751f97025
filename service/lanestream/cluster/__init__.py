"""The service on a Ray cluster: the application of `lanestream.api` as a deployment of Ray Serve."""
