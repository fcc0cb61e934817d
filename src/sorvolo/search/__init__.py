"""What a search would have seen: the probability of detection over the ground, and the figures made from it."""
