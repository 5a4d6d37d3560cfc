"""Bake stage: the fitted material as texture maps on the UV mesh."""
