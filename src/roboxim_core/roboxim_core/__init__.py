"""Shared code of all RoboXim packages, without ROS: value types, errors, seeds, configuration, models, kinematics."""
