"""Action chunking with transformers (ACT) on a pre-trained encoder: each action of a chunk is a query."""
