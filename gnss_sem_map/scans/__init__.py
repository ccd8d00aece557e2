"""One scan: moved into the map without motion distortion, thinned, projected into its image, matched with others."""
