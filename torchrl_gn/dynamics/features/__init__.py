"""What the network sees of a state."""
