"""How two views of the same ground fit; used by the mosaic and by change detection."""
