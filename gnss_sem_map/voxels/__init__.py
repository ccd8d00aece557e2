"""The voxel map: integer log-likelihood sums per voxel, in memory and in tiles."""
