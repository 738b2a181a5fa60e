"""Proofs that an experiment was delivered: demands of cells, read from bags, a bag per job."""
