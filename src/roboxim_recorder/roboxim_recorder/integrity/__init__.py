"""Whether a bag is whole, and what is saved of a damaged one."""
