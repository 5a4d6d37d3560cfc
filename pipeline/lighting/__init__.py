"""A distant light around one mesh: as a dome, as lamps, and as it arrives at the vertices."""
