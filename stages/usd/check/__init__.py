"""`neuface validate`: checks of an exported asset."""
