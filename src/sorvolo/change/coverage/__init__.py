"""What a comparison could see of the ground: where, how often, and how small a thing."""
