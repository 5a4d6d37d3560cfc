"""The demo capture: a modelled head with known skin, light and cameras, and its own renderer."""
