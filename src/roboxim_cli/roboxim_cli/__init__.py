"""The ``roboxim`` command: parse, call, print."""
