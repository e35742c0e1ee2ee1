"""A master, and a rospy node at it with a service whose type is made from text."""
import os
import sys

sys.modules['std_srvs'] = None  # as if not installed
import rosmaster.master  # noqa: E402
import rospy  # noqa: E402

from pharos.messages import define_service, fill  # noqa: E402

master = rosmaster.master.Master(port=0)
master.start()
os.environ['ROS_MASTER_URI'] = master.uri
SetBool = define_service('std_srvs/SetBool', 'bool data\n---\nbool success\nstring message\n')


def switch(request):
    answer = {'success': request.data, 'message': 'made at run time'}
    return fill(SetBool._response_class(), answer)


rospy.init_node('server', disable_signals=True)
rospy.Service('switch', SetBool, switch)
print(rospy.ServiceProxy('switch', SetBool)(True).message)
print(master.uri, flush=True)
sys.stdin.read()
os._exit(0)
