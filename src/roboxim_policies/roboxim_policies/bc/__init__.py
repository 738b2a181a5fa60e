"""Behaviour cloning: a small network, its training from an RLDS export, and the policy that runs it.

Only `network`, `train`, `checkpoint` and `policy` import JAX; `config` and `data` do not.
"""
