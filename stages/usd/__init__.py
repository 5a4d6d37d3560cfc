"""Writes the USD component, its look-dev rig and a preview package, checks them, and renders the exported files."""
