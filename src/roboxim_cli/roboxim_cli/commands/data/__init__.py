"""The commands for bags and datasets."""
