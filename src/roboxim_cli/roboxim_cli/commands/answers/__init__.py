"""Commands that answer what no success rate says."""
