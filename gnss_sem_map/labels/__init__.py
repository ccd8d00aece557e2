"""Class sets, and what the answers of a network are worth as evidence for their classes."""
