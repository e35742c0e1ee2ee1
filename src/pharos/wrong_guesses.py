"""What those who know rospy, or ROS 2, try first under a name that is not there: what to write."""
import functools
import inspect
from typing import Any, Callable, Dict, List, TypeVar, cast

from pharos.errors import suggest
from pharos.private_rospy.process_rospy import rospy

_PUBLISH = "node.send_to('/topic', typed_as='std_msgs/String', data='x'), or node.output_channel()"
_SUBSCRIBE = "node.interested_in('/topic', delegate=lambda message, channel: ...)"
_SERVE = 'node.serve(name, typed_as, block)'
_CALL = 'node.lookup_service(name).call(field=value)'
_LOOP = 'for _ in node.every(0.1), which turns ten times a second'
_LOG = "node.log(text), or node.log(text, level='warning')"
_PARAMETER = "node.parameter('~name', initialized=1).value, or master.parameters['/name']"
_RUNS = 'node.is_running; and a loop over node.every(seconds) ends with the node by itself'
_STOP = 'node.stop()'
_TIME = 'node.ros.Time.now()'

_RATES = ['hz', 'rate', 'frequency']

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
    'wait_for_service': 'node.wait_for_service(name, timeout)',
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
    'create_node': "master.create(BlockNode, named='/name')",
    'param': _PARAMETER,
    'parameters': "node.parameter('~name'), or node.master.parameters",
    'topics': 'node.channels, or master.topics()',
    'connections': 'channel.connections, for each channel in node.channels',
    'get_published_topics': 'master.topics()',
    'myargv': 'sys.argv, which create(..., argv=sys.argv) takes for a node',
}

#: keyword -> those that are guessed in its place
_KEYWORDS: Dict[str, List[str]] = {
    'named': ['name', 'node_name'],
    'typed_as': ['type', 'data_class', 'msg_type', 'srv_type', 'topic_type', 'service_class'],
    'delegate': ['callback', 'cb', 'block', 'handler'],
    'block': ['callback', 'cb', 'handler', 'delegate'],
    'initialized': ['default', 'value', 'default_value'],
    'from_': ['sender', 'node'],
    '*args': ['args', 'argv', 'arguments'],
    'seconds': ['period', 'duration', *_RATES],
}
Class = TypeVar('Class', bound=type)
Function = TypeVar('Function', bound=Callable[..., Any])


def names_its_methods(cls: Class) -> Class:
    """Class decorator: what Python complains of a call of a method, it says of this class, which
    users know, and not of that among its bases which has the method."""
    for name, method in inspect.getmembers(cls, inspect.isfunction):
        for function in method, inspect.unwrap(method):
            function.__qualname__ = f'{cls.__name__}.{name}'
    return cls


def tells_keywords(function: Function) -> Function:
    """Decorator: where a call of the function has a keyword that it does not take, the error says
    which was meant. A call that is right is not looked at."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except TypeError as error:
            frames = error.__traceback__
            if frames is not None and frames.tb_next is None:  # the function has not begun
                known = [
                    '*' + each.name if each.kind is each.VAR_POSITIONAL else each.name
                    for each in inspect.signature(function).parameters.values()
                ]
                error.args = (f'{error}{keyword_hint(known, kwargs)}',)
            raise

    return cast(Function, call)


def keyword_hint(known: List[str], given: Dict[str, Any]) -> str:
    """The end of the complaint that a keyword is not known, or one is missing; empty where nothing
    is near.

    :param known: the keywords that there are, and '*args'
    :param given: those of the call
    """
    shown = {name: name if name.startswith('*') else f'{name}=' for name in known}
    for wrong in given:
        if wrong not in known:
            meant = [shown[name] for name in known if wrong in _KEYWORDS.get(name, ())]
            found = suggest(f'{wrong}=', shown.values(), meant)
            return found + (f', which is 1 / {wrong}' if meant and wrong in _RATES else '')
    return ''


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
        told = '' if hasattr(type(thing), name) else hint(name) or _spelt_otherwise(thing, name)
        if told:
            error.args = (f'{error}{told}',)
            setattr(error, 'obj', None)  # else Python adds its own suggestion when it prints it
        raise


def _spelt_otherwise(thing: Any, name: str) -> str:
    """The hint at a name that is spelt so but for capitals and underscores, as in the report's
    Smalltalk: ``sendTo``; or else but for a slip."""
    if name.startswith('_'):
        return ''  # whether it is there ask Python and IPython, of whatever there is
    plain = name.replace('_', '').lower()
    names = [own for own in dir(thing) if not own.startswith('_')]
    return suggest(name, names, [own for own in names if own.replace('_', '') == plain])
