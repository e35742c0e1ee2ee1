"""Another process starts a node of our name: ROS's rule is that the newer one stays, and the older
one ends."""
import sys

import pytest

from helpers import create
from pharos.testing import TIMEOUT, until
from pharos import BlockNode, ExternalNode, Lifecycle, node_registry, watcher
from pharos.private_rospy import registration
from programs import Program, forget_parameters

ROSPY_NODE = """
import rospy, std_msgs.msg
rospy.init_node('contested', disable_signals=False)
sub = rospy.Subscriber('/newer_hears', std_msgs.msg.String, lambda message: print('heard', message.data, flush=True))
print('ready', flush=True)
rospy.spin()
print('ended', flush=True)
"""


def wait_for_stop(node):
    with node_registry.changed:
        assert node_registry.changed.wait_for(lambda: node.lifecycle is Lifecycle.STOPPED, TIMEOUT)


def check_it_stays(master, topic):
    """The newer one is registered and answers, and nothing of ours is left."""
    newer = master.node('/contested')
    assert isinstance(newer, ExternalNode)
    assert newer.is_alive()
    assert topic in newer.subscriptions
    assert '/ours' not in newer.publications
    assert '/ours/set_logger_level' not in newer.services


def rospy_node(master):
    return Program(master.url, sys.executable, '-c', ROSPY_NODE)


@pytest.mark.parametrize('logs_before', [True, False])
def test_a_newer_node_of_rospys_stays(master, logs_before):
    ours = create(master, '/contested')
    ours.output_channel('/ours', 'std_msgs/String')
    if logs_before:
        ours.log('here I am')
    with rospy_node(master) as newer:
        newer.wait_for('ready')
        wait_for_stop(ours)
        check_it_stays(master, '/newer_hears')
        speaker = master.create(BlockNode, named='/speaker', domain='127.0.0.1')
        speaker.send_to('/newer_hears', data='still there', typed_as='std_msgs/String')
        newer.wait_for('heard still there')
        assert newer.process.poll() is None


def test_a_newer_node_of_roscpps_stays(master):
    ours = create(master, '/contested')
    with master.run(
        'topic_tools', 'relay', '/newer_takes', '/newer_gives', name='contested'
    ) as newer:
        wait_for_stop(ours)
        until(lambda: '/newer_takes' in ExternalNode(master, '/contested').subscriptions)
        check_it_stays(master, '/newer_takes')
        assert newer.poll() is None


def test_what_a_node_opens_and_says_while_it_gives_way_is_not_registered(master):
    class Talkative(BlockNode):
        def stop(self):
            self.log('I go')
            self.output_channel('/ours', 'std_msgs/String')
            self.serve('/ours/late', 'std_srvs/Empty', lambda request: None)
            self.parameter('/ours/parameter', 1).on_change(print)
            super().stop()
            self.log('I went')

    ours = master.create(Talkative, named='/contested', domain='127.0.0.1')
    with rospy_node(master) as newer:
        newer.wait_for('ready')
        wait_for_stop(ours)
        check_it_stays(master, '/newer_hears')
        assert '/ours/late' not in master.services()
        assert newer.process.poll() is None
    forget_parameters(master.url)


def test_a_node_that_was_not_told_notices(master, monkeypatch):
    """It finds its registrations gone, and does not take the name back."""
    monkeypatch.setattr(watcher, 'PERIOD', 0.05)
    # it does not obey
    monkeypatch.setattr(registration, 'name_is_anothers', lambda node: False)
    ours = create(master, '/contested')
    ours.output_channel('/ours', 'std_msgs/String')
    with rospy_node(master) as newer:
        newer.wait_for('ready')
        wait_for_stop(ours)
        check_it_stays(master, '/newer_hears')
        assert newer.process.poll() is None
