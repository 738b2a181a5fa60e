"""The subcommands, one file each, found by file name: ``commands/<name>.py`` with a `click` command named ``command``.

The first line of the module's docstring is the short help. Import heavy modules (rclpy, numpy, a room) inside the
functions: the module itself is imported already for its help and completion.
"""
