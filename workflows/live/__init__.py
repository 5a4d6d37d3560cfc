"""What a run tells while it goes on, for `neuface view`, and what the viewer asks of it."""
