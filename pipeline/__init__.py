"""The core of NeuFace Asset: contract, store, artifacts, conventions, maths. Imports neither stages nor workflows."""
