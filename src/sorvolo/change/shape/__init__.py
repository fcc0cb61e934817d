"""What a change looks like: its kind, outline, parts, shadows and pictures."""
