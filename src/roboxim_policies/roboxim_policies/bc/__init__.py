"""Behaviour cloning: a small network, its training from a dataset, and the policy that runs it.

`config`, `data`, `features` and `checkpoint_file` do not import JAX.
"""
