"""What the compiled module offers; reference.py and reference_robust.py say what it does."""
