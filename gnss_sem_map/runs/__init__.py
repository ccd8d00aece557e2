"""A run as a folder and as an object: written, read, refined, labelled and exported again."""
