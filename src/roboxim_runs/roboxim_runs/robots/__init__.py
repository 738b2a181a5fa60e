"""Robots of the user: a URDF made into the files that RoboXim uses, checked and drawn."""
