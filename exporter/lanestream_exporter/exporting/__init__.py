"""From a checkpoint to a model file that describes itself and has proved itself."""
