"""The voxel map: integer sums of log-likelihoods per voxel, in memory and in tiles."""
