"""What a flight's search would have seen: things planted into its frames, searched and counted."""
