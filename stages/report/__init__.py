"""Compares the result with the held-out photos, and writes one self-contained HTML page about it."""
