"""Everything that runs offline, up to the ONNX file: labels, rendered scenes, training, evaluation, export."""
