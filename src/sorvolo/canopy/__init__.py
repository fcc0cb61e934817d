"""The ground below crowns: pictures from many places laid on it and put together (synthetic aperture)."""
