"""Libraries written on rospy: what they take for granted because sockets are slow."""
from pharos.private_rospy.patches.table import patch

CLIENT = 'actionlib.simple_action_client'


@patch(
    CLIENT,
    'SimpleActionClient.send_goal',
    'does not know its goal before this has returned, and waits for ever where the answer comes'
    ' sooner',
)
def send_goal(self, goal, done_cb=None, active_cb=None, feedback_cb=None, *, original):
    """Have what comes meanwhile wait."""
    with self.done_condition:
        original(self, goal, done_cb=done_cb, active_cb=active_cb, feedback_cb=feedback_cb)


@patch(CLIENT, 'SimpleActionClient._handle_transition', 'drops what comes before send_goal is done')
def handle_transition(self, gh, *, original):
    """Wait until it is."""
    with self.done_condition:
        pass
    original(self, gh)


@patch(CLIENT, 'SimpleActionClient._handle_feedback', 'drops what comes before send_goal is done')
def handle_feedback(self, gh, feedback, *, original):
    """Wait until it is."""
    with self.done_condition:
        pass
    original(self, gh, feedback)
