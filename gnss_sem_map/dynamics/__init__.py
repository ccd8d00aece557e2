"""Moving objects, found in the scans before there is a map."""
