"""The graph of all nodes: launch, supervision, attaching, checks of the machine."""
