"""Action chunking with transformers (ACT) on a pre-trained encoder: each action of a chunk asks the tokens itself."""
