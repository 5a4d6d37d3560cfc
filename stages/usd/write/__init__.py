"""The files of the asset."""
