"""The kernels of the thesis's change detection in NumPy: the specification of the compiled ones."""
