"""`sorvolo watch`: people, cars and objects in a flight or a live stream."""
