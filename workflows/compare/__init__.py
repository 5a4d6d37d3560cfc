"""`neuface compare`: two runs side by side."""
