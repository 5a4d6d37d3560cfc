"""`neuface validate`: is an exported asset what it says?"""
