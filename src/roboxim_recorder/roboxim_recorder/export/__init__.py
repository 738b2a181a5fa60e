"""Exports bags as datasets."""
