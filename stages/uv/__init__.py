"""UV stage: a decimated mesh with texture coordinates, and a proxy."""
