"""The laboratory: simulation, training, evaluation and the thesis; the product never imports it."""
