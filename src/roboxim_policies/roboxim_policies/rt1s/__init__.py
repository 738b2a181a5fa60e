"""A small relative of RT-1: words in FiLM, a pre-trained encoder, tokens, a causal transformer over a history."""
