"""Inverse rendering: photos, cameras and masks in, a fitted NeuFace field out. Start at stage.py, then fit.py."""
