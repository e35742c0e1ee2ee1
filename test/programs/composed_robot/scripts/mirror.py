#!/usr/bin/env python3
"""Says on 'mirrored' how it was started: arguments, environment, working directory, parameters."""
import json
import os
import sys

import rospy
from std_msgs.msg import String

rospy.init_node('mirror')
publisher = rospy.Publisher('mirrored', String, queue_size=1, latch=True)
told = {
    'argv': sys.argv,
    'environment': dict(os.environ),
    'folder': os.getcwd(),
    'parameters': rospy.get_param('~', {}),
}
publisher.publish(json.dumps(told))
print('printed by the mirror', flush=True)
rospy.spin()
