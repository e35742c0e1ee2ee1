"""A package whose modules import each other in a circle, each slowly, as told by the tests."""
import rospy

started = rospy.started
