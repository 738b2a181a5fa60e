"""One file per subcommand, found by its name: ``commands/<name>.py`` with a `click` command named ``command``.

The first line of the module's docstring is the short help. Import what is heavy (rclpy, numpy, a room) inside the
functions: the module itself is imported as soon as its help or its completion is asked for.
"""
