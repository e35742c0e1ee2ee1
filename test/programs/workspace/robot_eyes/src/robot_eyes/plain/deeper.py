"""In a folder without __init__.py."""
import rospy

NAME = rospy.get_name()
