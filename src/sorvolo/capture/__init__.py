"""Frames and telemetry from files: videos, photos, cameras, areas, and the clock that ties them together."""
