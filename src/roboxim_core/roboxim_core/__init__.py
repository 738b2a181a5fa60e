"""What every room of RoboXim shares, without ROS: value types, errors, seeds, configuration, models, kinematics."""
