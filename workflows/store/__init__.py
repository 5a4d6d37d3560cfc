"""Clearing up a store of finished artifacts."""
