"""A file that programs run in odd ways.

>>> NAME
'/program_node'
"""
import rospy

NAME = rospy.get_name()
