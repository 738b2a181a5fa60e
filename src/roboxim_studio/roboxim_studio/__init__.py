"""The studio: view, edit and drive episodes, scenes and tasks in a browser."""
