"""Pictures of another size than the flight's: the same view in more or fewer pixels, or another view."""

_SAME_ASPECT = 0.01  # relative; by choice


def is_same_shape(size_px: tuple[int, int], flight_px: tuple[int, int]) -> bool:
    """Whether pictures of two sizes (width, height) show the same view, but for a hundredth of their aspect."""
    (width_px, height_px), (flight_width_px, flight_height_px) = size_px, flight_px
    return abs(width_px * flight_height_px / (height_px * flight_width_px) - 1) <= _SAME_ASPECT


def other_size(size_px: tuple[int, int], flight_px: tuple[int, int]) -> str:
    """Why a picture of another shape (width, height) is not used, in words."""
    return f"size {size_px[0]}x{size_px[1]} differs from the flight's {flight_px[0]}x{flight_px[1]}"
