"""Findings: one thing on the ground is one finding, from every mission and over time."""
