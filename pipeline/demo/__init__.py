"""The demo capture: a sculpted head with known skin, light and cameras, and a path of its own to its photos."""
