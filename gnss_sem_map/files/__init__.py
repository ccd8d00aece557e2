"""Reading files that nobody can trust, and writing results without harm to what stands there."""
