"""What those who know rospy, or ROS 2, try first under a name that is not there: what to write."""
from typing import Any

from pharos.private_rospy.process_rospy import rospy

_PUBLISH = "node.send_to('/topic', typed_as='std_msgs/String', data='x'), or node.output_channel()"
_SUBSCRIBE = "node.interested_in('/topic', delegate=lambda message, channel: ...)"
_SERVE = 'node.serve(name, typed_as, block)'
_CALL = 'master.lookup_service(name).call(field=value)'
_LOOP = 'for _ in node.every(0.1), which turns ten times a second'
_LOG = "node.log(text), or node.log(text, level='warning')"
_PARAMETER = "node.parameter('~name', initialized=1).value, or master.parameters['/name']"
_RUNS = 'node.is_running; and a loop over node.every(seconds) ends with the node by itself'
_STOP = 'node.stop()'
_TIME = 'node.ros.Time.now()'

# name -> what to write in its place
_TABLE = {
    'init_node': "Master().create(BlockNode, named='/name')",
    'Publisher': _PUBLISH,
    'advertise': _PUBLISH,
    'create_publisher': _PUBLISH,
    'publish': _PUBLISH,
    'Subscriber': _SUBSCRIBE,
    'subscribe': _SUBSCRIBE,
    'create_subscription': _SUBSCRIBE,
    'Service': _SERVE,
    'advertise_service': _SERVE,
    'create_service': _SERVE,
    'ServiceProxy': _CALL,
    'call_service': _CALL,
    'create_client': _CALL,
    'wait_for_service': 'node.master.wait_for_service(name, timeout)',
    'Rate': _LOOP,
    'create_rate': _LOOP,
    'create_timer': 'a soul, in a thread of its own by fork(), and there: ' + _LOOP,
    'spin': 'pharos.spin()',
    'is_shutdown': 'its opposite, ' + _RUNS,
    'ok': _RUNS,
    'signal_shutdown': _STOP,
    'shutdown': _STOP,
    'destroy_node': _STOP,
    'close': _STOP,
    'on_shutdown': 'a stop() of your own class, which calls super().stop()',
    'loginfo': _LOG,
    'logwarn': _LOG,
    'logerr': _LOG,
    'logdebug': _LOG,
    'logfatal': _LOG,
    'get_logger': _LOG,
    'get_param': _PARAMETER,
    'get_parameter': _PARAMETER,
    'has_param': _PARAMETER,
    'declare_parameter': _PARAMETER,
    'set_param': "node.parameter('~name').set(value), or master.parameters['/name'] = value",
    'delete_param': "del master.parameters['/name']",
    'get_param_names': 'list(master.parameters)',
    'get_name': 'node.name',
    'get_node_uri': 'node.uri',
    'get_time': _TIME,
    'get_rostime': _TIME,
    'get_clock': _TIME,
    'now': _TIME,
    'topics': 'node.channels, or master.topics()',
    'connections': 'channel.connections, for each channel in node.channels',
    'get_published_topics': 'master.topics()',
    'myargv': 'sys.argv, which create(..., argv=sys.argv) takes for a node',
}


def hint(name: str) -> str:
    """The end of the complaint that there is no such name; empty where it is no known guess."""
    if name in _TABLE:
        return f': write {_TABLE[name]}'
    if not name.startswith('_') and callable(getattr(rospy, name, None)):
        return f': what rospy has by that name is node.ros.{name}'
    return ''


def getattr_with_hint(thing: Any, name: str) -> Any:
    """``__getattr__`` of a class: the error that Python raises anyway, with a hint.

    Python calls it also where a property has raised an AttributeError, which is raised again. It
    makes each look-up of an attribute some nanoseconds slower, and is not for channels.
    """
    try:
        return object.__getattribute__(thing, name)
    except AttributeError as error:
        if not hasattr(type(thing), name):
            error.args = (f'{error}{hint(name)}',)
        raise
