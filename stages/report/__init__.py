"""Judges the result against photos that the fit has not seen, and writes one self-contained page about it."""
