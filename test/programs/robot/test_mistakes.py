"""Tests that fail: because of what they leave, or do not look at."""
import threading

from robot import Echo

from pharos import BlockNode, testing


def test_leaves_a_node(master):
    master.create(BlockNode, named='/forgotten', domain='127.0.0.1')


def test_leaves_a_thread(master, monkeypatch):
    monkeypatch.setattr(testing, 'TIMEOUT', 0.1)
    threading.Thread(target=threading.Event().wait, name='forgotten', daemon=True).start()


def test_leaves_a_registration(master, monkeypatch):
    monkeypatch.setattr(testing, 'TIMEOUT', 0.1)
    import rosgraph

    api = rosgraph.Master('/forgotten', master.url)
    api.registerPublisher('/topic', 'std_msgs/String', 'http://127.0.0.1:1/')


def test_does_not_look_at_a_failure(create_node):
    echo = create_node(Echo)
    echo.send_to('/heard', typed_as='std_msgs/String', data='')
    testing.until(lambda: echo.failures)
