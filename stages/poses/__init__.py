"""Cameras around the subject: given, or solved from the photos by structure from motion."""
