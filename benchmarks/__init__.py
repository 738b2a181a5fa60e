"""RoboXim's benchmarks, a folder for each subject; `make bench-NAME` runs one."""
