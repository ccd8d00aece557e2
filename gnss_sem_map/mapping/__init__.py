"""From a drive to a voxel map: trajectory, labelled scans, fusion in parallel with checkpoints, merging of maps."""
