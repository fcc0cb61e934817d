"""An archive: the sites of a folder, indexed and found by place and time."""
