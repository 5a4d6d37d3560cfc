"""Eyeballs: their place, iris and colours, from the fitted surface and the photos."""
