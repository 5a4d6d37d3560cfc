"""The core of NeuFace Asset: contract, store, artifacts, conventions and mathematics. Knows neither stages nor workflows."""
