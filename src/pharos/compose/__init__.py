"""rospy programs and launch files, unmodified, as nodes of this process."""
