"""Proofs that an experiment's demonstrations and evaluations match its cells."""
