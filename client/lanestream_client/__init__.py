"""The Lanestream client: frames to a service, lane lines back."""
