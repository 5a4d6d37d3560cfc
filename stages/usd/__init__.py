"""Writes the USD component, its look-dev scene and a preview package, checks them, and renders the exported files."""
