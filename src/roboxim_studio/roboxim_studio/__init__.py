"""The studio: episodes, scenes and tasks, seen, edited and driven in a browser."""
