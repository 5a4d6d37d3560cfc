"""Checks the user's photos and gathers what takes part in one place."""
