"""Datasets: exports, conversions, audits, planted faults, and the replay gate."""
