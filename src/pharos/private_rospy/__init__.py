"""A rospy of its own for each node: the only place that touches rospy's inside.

rospy keeps its node in module globals. These modules load rospy's code once per node instead, and
mend what it does badly. Each override says which behaviour of rospy 1.15 it replaces, so that
another release is checked here and nowhere else. :class:`~.instance.PrivateRospy` is the door.
"""
