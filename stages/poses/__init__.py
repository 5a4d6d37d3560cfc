"""Cameras around the subject: given ones as they are, or solved from the photos."""
