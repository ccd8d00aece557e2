"""From a drive to a voxel map: trajectory, labelled scans and fusion in parallel with checkpoints."""
