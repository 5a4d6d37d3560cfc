"""The command line `neuface`."""
