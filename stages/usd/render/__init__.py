"""A CPU renderer of the exported files."""
