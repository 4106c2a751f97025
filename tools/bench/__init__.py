"""`make bench`: the service beside the pipeline in process, a naive service and LitServe, on the same frames."""
