"""People, cars and small objects drawn into pictures, to measure what a search would find."""
