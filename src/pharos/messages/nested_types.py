"""The classes of the messages in a message's fields."""
import genpy

_TIMES = {'time': genpy.Time, 'duration': genpy.Duration}


def nested_class(cls, type_name):
    """Return the class that a message class's own code means by the name of a type among its
    fields.

    It is not always the installed class of that name: a class made at run time nests others made
    with it. None for a class written by hand that nests what is not installed.
    """
    if type_name in _TIMES:
        return _TIMES[type_name]
    if type_name == 'Header':
        type_name = 'std_msgs/Header'
    package, _, name = type_name.rpartition('/')
    package = package or cls._type.partition('/')[0]
    # of pharos.messages.message_definition
    made_together = getattr(cls, '_classes', {}).get(f'{package}/{name}')
    # a numpy_msg has its serialize from rospy, and these from the class that it derives from
    names = getattr(getattr(cls, 'serialize_numpy', None), '__globals__', {})
    # of genpy.dynamic, all in one module
    made_together = made_together or names.get(f'_{package}__{name}')
    imported = getattr(getattr(names.get(package), 'msg', None), name, None)
    return made_together or imported or genpy.message.get_message_class(f'{package}/{name}')
