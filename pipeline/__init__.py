"""The core of NeuFace Asset: contract, store, artifacts, conventions, mathematics. Knows neither stages nor workflows."""
