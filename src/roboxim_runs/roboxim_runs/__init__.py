"""Runs: the stages of work that take minutes, as functions of frozen configurations.

Each subject has a folder: `episodes`, `evaluation`, `datasets`, `experiments`, `training`. A run takes a configuration,
reports progress by the events of `events`, and returns a value. It prints nothing and reads no command line. It can be
cancelled; the same call continues where it stopped. The `roboxim` package offers these functions to scripts and
notebooks; the commands parse, call and print.
"""
