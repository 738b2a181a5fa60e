"""Policies of a run: names and options, servers and what they are recognised by, dry runs."""
