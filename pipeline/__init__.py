"""The core of NeuFace Asset: contract, store, artifacts, conventions, maths. Knows neither stages nor workflows."""
