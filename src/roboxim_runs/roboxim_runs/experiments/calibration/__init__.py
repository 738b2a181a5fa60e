"""This machine's rates: measured, learned from finished runs, kept."""
