"""What the views of a flight show of each change, gathered on the ground until one may be announced."""
