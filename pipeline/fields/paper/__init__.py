"""Parts of the systems that the paper compares, for comparisons. Only pipeline.fields.build uses them."""
