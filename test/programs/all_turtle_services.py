"""Calls every service of the turtle simulator, by name and keywords alone."""
import importlib.util
import queue

import pharos

assert importlib.util.find_spec('turtlesim') is None
master, called = pharos.Master(), {}


def call(name, /, **fields):
    service = called[name] = master.lookup_service(name)
    return service.call(timeout=20, **fields)


def pose():
    """The first pose of turtle2 that has been told since."""
    with master.create(pharos.BlockNode, named='/looks_on', domain='127.0.0.1') as node:
        poses = queue.SimpleQueue()
        node.interested_in('/turtle2/pose', delegate=lambda pose, channel: poses.put(pose))
        pose = poses.get(timeout=20)
        return pose.x, pose.y, pose.theta


assert call('/spawn', x=1.0, y=2.0).name == 'turtle2'
assert pose() == (1.0, 2.0, 0.0)
call('/turtle2/set_pen', r=255, width=3)
call('/turtle2/teleport_absolute', x=3.0, y=4.0)
assert pose() == (3.0, 4.0, 0.0)
call('/turtle2/teleport_relative', linear=1.0)
assert pose() == (4.0, 4.0, 0.0)
for name in 'set_pen', 'teleport_absolute', 'teleport_relative':
    call('/turtle1/' + name)
call('/clear')
assert call('/turtlesim/save_picture').success
call('/turtlesim/set_logger_level', logger='rosout', level='warn')
levels = {logger.name: logger.level for logger in call('/turtlesim/get_loggers').loggers}
assert levels['rosout'] == 'WARN', levels
offered = set(master.node('/turtlesim').services)
call('/kill', name='turtle2')
assert '/turtle2/set_pen' not in master.services()
call('/spawn', name='bob')
call('/reset')
assert '/bob/set_pen' not in master.services()
assert offered == set(called), offered ^ set(called)
print('called', *sorted(service.type for service in called.values()))
