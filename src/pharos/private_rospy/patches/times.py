"""Times, which leave the node that made them."""
import genpy

from pharos.private_rospy.patches.table import addition

_NEEDS_CLASS = 'is of a class that only this node has, which no pickle finds again'
_COPIED = 'is of the same class when copied, though not when pickled'


@addition('rospy.rostime', 'Time.__reduce__', _NEEDS_CLASS)
def reduce_time(self):
    """Be pickled as genpy's."""
    return genpy.Time, (self.secs, self.nsecs)


@addition('rospy.rostime', 'Duration.__reduce__', _NEEDS_CLASS)
def reduce_duration(self):
    """Be pickled as genpy's."""
    return genpy.Duration, (self.secs, self.nsecs)


@addition('rospy.rostime', 'Time.__copy__', _COPIED)
@addition('rospy.rostime', 'Duration.__copy__', _COPIED)
@addition('rospy.rostime', 'Time.__deepcopy__', _COPIED)
@addition('rospy.rostime', 'Duration.__deepcopy__', _COPIED)
def copy_time(self, memo=None):
    """Copy it."""
    return type(self)(self.secs, self.nsecs)
