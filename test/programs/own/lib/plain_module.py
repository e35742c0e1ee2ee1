"""A module that does not reach rospy, in a folder that only one program knows."""
USERS = []
