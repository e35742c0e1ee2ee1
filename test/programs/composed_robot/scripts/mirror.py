#!/usr/bin/env python3
"""Says on 'mirrored' how it was started: arguments, environment, working directory, parameters; and
where it is, asked for by 'where': in a callback, and in a child process."""
import json
import os
import subprocess
import sys

import rospy
from std_msgs.msg import String


def where(request):
    """Answer 'where'."""
    child = subprocess.check_output(['pwd'], text=True).strip()
    publisher.publish(f'{os.getcwd()} {child}')


rospy.init_node('mirror')
publisher = rospy.Publisher('mirrored', String, queue_size=1, latch=True)
told = {
    'argv': sys.argv,
    'environment': dict(os.environ),
    'folder': os.getcwd(),
    'parameters': rospy.get_param('~', {}),
}
print('printed by', 'the mirror')
print('complained', file=sys.stderr)
publisher.publish(json.dumps(told))
rospy.Subscriber('where', String, where)
rospy.spin()
