"""Runs: the stages of work that take minutes, as functions of frozen configurations.

Each subject has a file: `generation`, `evaluation`, `export`, `training`, `rerendering`. A run takes a configuration,
tells what happens by the events of `events`, and returns a value. It prints nothing and reads no command line. It can
be cancelled, and the same call goes on where it stopped. The `roboxim` package offers these functions to scripts and
notebooks; the commands parse, call and print.
"""
