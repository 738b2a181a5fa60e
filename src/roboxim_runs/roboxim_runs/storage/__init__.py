"""A run on disk: folder, results, events, stores, shards that become one run."""
