"""The subcommands, one file each, found by file name in this folder, its folders and `roboxim_cli.ros`.

A file has a `click` command named ``command``; one whose name begins with ``_`` belongs to another file.

The first line of the module's docstring is the short help. Import heavy modules (rclpy, numpy, a room) inside the
functions: the module itself is imported already for its help and completion.
"""
