"""Many captures, each a run of its own."""
