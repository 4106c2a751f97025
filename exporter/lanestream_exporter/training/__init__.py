"""Training: what a run is told, the loop that every network learns in, and what the networks are trained for."""
