"""Processing of frames in threads or worker processes, and admission to them."""
