"""Functional mathematics, one object a file. Tensors in, tensors out: no modules, no files, no settings."""
