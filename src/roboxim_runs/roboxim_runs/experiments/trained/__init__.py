"""What an experiment trains with and evaluates: exports, policies, servers of checkpoints."""
