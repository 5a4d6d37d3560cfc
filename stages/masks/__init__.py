"""masks: photos and cameras in, one soft mask of the subject per view out."""
