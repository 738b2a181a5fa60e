"""Calls and ticks between nodes of one process, without the middleware."""
