"""Inverse rendering: fits a NeuFace model to photos, cameras and masks. Start reading at stage.py, then fit.py."""
