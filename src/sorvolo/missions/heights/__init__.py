"""`sorvolo heights` and `sorvolo measure`: heights of mapped flights, and what is measured on them."""
