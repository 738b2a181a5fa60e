"""What all trained policies share: data, samples, training, checkpoints, validation, and the policy that runs them.

A family (`families`) adds a configuration and a network. `config`, `data`, `features`, `families` and `checkpoint_file`
do not import JAX.
"""
