"""The scripted expert: solver, reference trajectory, policy."""
