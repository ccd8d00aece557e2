"""A GNSS/IMU trajectory from a factor graph, with covariance one can believe.

Knows no map and no scans. Read in this order: `measurements` and `geodesy` (what goes in), `smoothing`
(the graph), `trajectory` (what comes out), `accuracy` (how good it is), `simulation` (exact truth to test
against), `streaming` (fix by fix) and `kalman` (the baseline).
"""
