"""`neuface bench`: measurements that repeat."""
