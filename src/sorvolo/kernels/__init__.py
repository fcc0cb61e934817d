"""The few loops that must be fast; numbers in, numbers out. This module is the only door."""
