"""Policies of a run: names and options, servers and their identity, dry runs."""
