"""The extended Faster R-CNN in PyTorch (an extra: only here may torch be imported)."""
