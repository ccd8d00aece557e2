"""Moving objects: found in the scans by free-space evidence, while they are mapped."""
