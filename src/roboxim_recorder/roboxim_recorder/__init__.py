"""Recordings, exports, data set audits, and the recorder node."""
