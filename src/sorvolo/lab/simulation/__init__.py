"""A synthetic site and flights over it with known truth; pure, from memory."""
