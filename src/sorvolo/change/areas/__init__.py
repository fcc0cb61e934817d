"""Ground that changed as an area: paved, ploughed, heaped, flooded, built over."""
