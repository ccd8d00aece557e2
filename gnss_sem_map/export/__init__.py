"""The map and the trajectory as files that CloudCompare, QGIS, evo and a browser open as they are."""
