"""One run on this machine: its plan, its stages in order, what it publishes."""
