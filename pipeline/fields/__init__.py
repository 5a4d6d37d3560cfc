"""nn.Modules over the mathematics: geometry, appearance, light, calibration; and the fitted face as one object."""
