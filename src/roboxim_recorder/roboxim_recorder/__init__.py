"""Recordings, exports, dataset audits, and the recorder node."""
