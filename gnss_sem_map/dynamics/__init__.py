"""Moving objects: found in the scans by free-space evidence, before the map is built."""
