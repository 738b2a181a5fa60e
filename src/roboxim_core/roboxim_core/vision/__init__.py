"""Cameras, images, and the interface of renderers."""
