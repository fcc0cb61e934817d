"""Detections over time: objects with a place, each counted once."""
