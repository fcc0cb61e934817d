"""Heights from the flight itself: cameras in 3D, a height model with its error, bare ground, a true orthophoto."""
