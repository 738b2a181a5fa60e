"""Code that all RoboXim nodes share: conversions, node base, blocking clients, QoS, parameters, runs."""
