"""`sorvolo train`: a detector from labelled pictures."""
