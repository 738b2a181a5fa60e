"""Pre-trained encoders of pictures and instructions, from the packages of the extra ``roboxim[pretrained]``.

`arrays_of_torch`, `weights` and `sentences` do not import JAX.
"""
