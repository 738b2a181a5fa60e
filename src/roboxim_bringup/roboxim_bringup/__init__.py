"""The runner of all nodes and the roboxim command line."""
