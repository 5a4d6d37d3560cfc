"""A result against known truth."""
