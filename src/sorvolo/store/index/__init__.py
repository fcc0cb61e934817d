"""The archive index: footprints, objects and changes of all sites of a folder, found by place and time."""
