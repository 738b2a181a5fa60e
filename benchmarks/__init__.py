"""RoboXim's benchmarks, in folders by subject; `make bench-NAME` runs one."""
