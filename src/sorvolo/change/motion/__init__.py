"""What moves: regions followed over views."""
