"""The parts of the systems that the paper compares, to compare with. pipeline.fields.build is the one door."""
