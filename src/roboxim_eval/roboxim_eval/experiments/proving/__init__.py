"""Proofs that an experiment's demonstrations and evaluations are what its cells say."""
