"""One scan: motion compensation, downsampling, projection into the image, registration and LiDAR odometry."""
