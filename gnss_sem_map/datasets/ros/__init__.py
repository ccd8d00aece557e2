"""ROS bags: where their messages are, what they say, and which sensor of the rig they belong to."""
