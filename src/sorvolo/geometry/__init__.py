"""Where things are: poses, cameras, the Earth, homographies, grids and the ground; NumPy and pyproj only."""
