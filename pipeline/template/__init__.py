"""A head with a topology that is the same for every person (docs/template.md)."""
