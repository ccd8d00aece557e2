"""Results and their place: what we may write, what we may remove, and what an interrupted command left."""
