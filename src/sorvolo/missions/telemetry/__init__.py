"""Corrected telemetry: what the map knows of the camera better than the log."""
