"""`sorvolo evaluate`: how good maps, changes, objects and detectors are."""
