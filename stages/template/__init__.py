"""Template stage: the head template, registered to the fitted surface."""
