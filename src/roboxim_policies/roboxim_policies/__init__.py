"""Policies: the server base class, wire adapters, shipped and trained policies."""
