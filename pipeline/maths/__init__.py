"""Mathematical functions, one subject per file. Tensors in, tensors out: no modules, no files, no settings."""
