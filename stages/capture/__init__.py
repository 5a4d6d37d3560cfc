"""Checks the user's photos and copies the ones that are used into one folder."""
