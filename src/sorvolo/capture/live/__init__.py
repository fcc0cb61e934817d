"""Flights that are still flying: streams, growing files and folders, webcams, and telemetry by wire or radio."""
