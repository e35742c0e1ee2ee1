"""Run unmodified programs of rospy, and the Python nodes of launch files, in this process."""
