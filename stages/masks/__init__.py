"""masks: one soft alpha mask of the subject for each view."""
