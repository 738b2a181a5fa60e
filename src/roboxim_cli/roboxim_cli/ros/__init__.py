"""The commands for a running graph, spelled as in ``ros2``."""
