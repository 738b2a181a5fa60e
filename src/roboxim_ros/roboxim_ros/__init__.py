"""What every node of RoboXim shares: conversions, node base, blocking clients, QoS, parameters, runs."""
