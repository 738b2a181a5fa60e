"""Dataset formats and the episode type that they share; no ROS, no bags."""
