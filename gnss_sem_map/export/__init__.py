"""Export of map and trajectory to files for CloudCompare, QGIS, evo and browsers."""
