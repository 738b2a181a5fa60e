"""Behaviour cloning: a small network, its training from an RLDS export, and the policy that runs it.

JAX is imported by `network`, `train`, `checkpoint` and `policy` only; `config` and `data` do without.
"""
