"""The use cases, where capture, the pure core and the store meet."""
