"""`sorvolo map`: flights into a map."""
