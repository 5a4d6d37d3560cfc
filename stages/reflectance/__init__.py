"""Reflectance stage: how each texel answers light, from the pictures of a light stage."""
