"""Scenes and tasks that are edited: the document, its steps back and forth, its YAML, its checks."""
