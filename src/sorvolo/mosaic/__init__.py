"""Many frames to one map, one frame at a time."""
