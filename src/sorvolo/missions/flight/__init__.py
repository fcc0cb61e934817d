"""What every mission over a flight shares: setup, report, detections, settings."""
