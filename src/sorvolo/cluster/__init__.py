"""The missions over many flights, on this machine or on a cluster of machines that share a disk."""
