"""Boxes from pixels, through ONNX Runtime; no torch."""
