"""A made-up person with long hair in a rig of cameras, as a capture with truth: see __main__.py."""
