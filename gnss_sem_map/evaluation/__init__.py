"""How good a log, a network or a map is: the pre-flight, map sharpness, scores against known labels."""
