"""`make bench`: the service against the in-process pipeline, a baseline service and LitServe, on the same frames."""
