"""Faces in photos, found offline by two small networks (models/NOTICE)."""
