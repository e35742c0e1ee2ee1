"""A rospy node that offers /layouts/spawn, of the definition given."""
import sys

import rospy

from pharos import define_service

rospy.init_node('layouts_there')
cls = define_service('layout_srvs/Spawn', sys.argv[1])
rospy.Service('/layouts/spawn', cls, lambda request: '%g %g' % (request.x, request.y))
print('ready', cls._md5sum, flush=True)
rospy.spin()
