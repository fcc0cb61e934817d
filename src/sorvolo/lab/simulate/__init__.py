"""`sorvolo simulate`: flights and pictures with known truth."""
