"""Sorvolo: geo-referenced maps from small drones while they fly, and what changed on the ground since."""

__version__ = "0.1.0"
