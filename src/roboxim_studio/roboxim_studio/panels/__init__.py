"""The panels beside the three-dimensional view."""
