"""Where frames are worked on: threads or processes, and who may work now."""
