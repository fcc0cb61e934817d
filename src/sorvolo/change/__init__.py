"""Two flights over one site: what changed on the ground."""
