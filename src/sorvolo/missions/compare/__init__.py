"""`sorvolo compare`: a later flight against the map."""
