"""Another process starts a node of our name: ROS's rule is that the newer one stays, and the older
one ends."""
import contextlib
import sys
import threading

import pytest

from helpers import create
from pharos.testing import TIMEOUT, until
from pharos import BlockNode, ExternalNode, Lifecycle, NodeStoppedError, node_registry, watcher
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


def obey_nobody(monkeypatch):
    """As if the master had not told the older node yet."""
    is_anothers = registration.name_is_anothers

    def known_here(node):
        thread = threading.current_thread().name
        return thread.startswith(('MainThread', 'watcher')) and is_anothers(node)

    monkeypatch.setattr(registration, 'name_is_anothers', known_here)


def test_a_node_that_was_not_told_notices(master, monkeypatch):
    """It finds its registrations gone, and does not take the name back."""
    monkeypatch.setattr(watcher, 'PERIOD', 0.05)
    obey_nobody(monkeypatch)
    ours = create(master, '/contested')
    ours.output_channel('/ours', 'std_msgs/String')
    with rospy_node(master) as newer:
        newer.wait_for('ready')
        wait_for_stop(ours)
        check_it_stays(master, '/newer_hears')
        assert newer.process.poll() is None


USES = {
    'log': lambda node: node.log('here I am'),
    'interested_in': lambda node: node.interested_in('/ours/in', 'std_msgs/String'),
    'output_channel': lambda node: node.output_channel('/ours/out', 'std_msgs/String'),
    'serve': lambda node: node.serve('/ours/late', 'std_srvs/Empty', lambda request: None),
    'on_change': lambda node: node.parameter('/ours/parameter').on_change(print),
}


@pytest.mark.parametrize('use', USES)
def test_a_node_that_is_not_told_yet_does_not_take_the_name_back(master, monkeypatch, use):
    """The master tells it only after it has registered the newer one, which would end by that."""
    ours = create(master)
    ours.log('so rospy subscribes to the parameter by which it leaves out the topics')
    obey_nobody(monkeypatch)
    newer, uri = master.api(ours.name), 'http://127.0.0.1:1/'
    newer.registerPublisher('/newer', 'std_msgs/String', uri)
    try:
        with contextlib.suppress(NodeStoppedError):  # it has just noticed
            USES[use](ours)
        assert master.uri_of(ours.name) == uri
    finally:
        newer.unregisterPublisher('/newer', uri)
