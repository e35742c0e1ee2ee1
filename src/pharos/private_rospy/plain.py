"""Plain rospy in a program whose nodes are made with pharos: it says what to write instead."""
import sys
import warnings

from pharos.private_rospy.loader import SYSTEM_FOLDERS

FUNCTIONS = (
    'loginfo logwarn logerr logdebug logfatal loginfo_once logwarn_once logerr_once get_param'
    ' loginfo_throttle logwarn_throttle logerr_throttle get_rostime get_time sleep'
    ' set_param has_param search_param get_name get_namespace on_shutdown spin wait_for_message'
).split()
CLASSES = 'Publisher Subscriber Service ServiceProxy Rate Timer'.split()


def guide(rospy, nodes):
    """Have functions and classes of rospy say what to write, if rospy has no node.

    ``rospy.is_shutdown()`` is then True when all nodes have stopped.

    :param rospy: the process's own rospy, or that of a composed program
    :param nodes: ``nodes()`` returns the nodes of pharos that start or run
    """
    had_nodes = False

    def watch(owner: object, attribute: str, name: str) -> None:
        original = getattr(owner, attribute)
        definition = vars(owner)[attribute]

        def call(*args: object, **kwargs: object) -> object:
            if rospy.core.is_initialized():
                setattr(owner, attribute, definition)  # or the log would name this file
            elif nodes():
                _advise(name)
            return original(*args, **kwargs)

        is_static = isinstance(definition, staticmethod)
        setattr(owner, attribute, staticmethod(call) if is_static else call)

    def is_shutdown(original=rospy.is_shutdown):
        nonlocal had_nodes
        if nodes():
            had_nodes = True
        elif had_nodes and not rospy.core.is_initialized():
            return True
        return original()

    rospy.is_shutdown = rospy.core.is_shutdown = is_shutdown
    for name in FUNCTIONS:
        watch(rospy, name, name)
    for name in CLASSES:
        watch(getattr(rospy, name), '__init__', name)
    watch(rospy.Time, 'now', 'Time.now')


def _advise(name: str) -> None:
    """Say what to write instead of a call of rospy, once for each place of such a call."""
    caller = sys._getframe(2)
    module = caller.f_globals['__name__'].partition('.')[0]
    if module == 'rospy':  # it was called itself, and has been told of
        return
    advice = f'node.ros.{name}'
    if caller.f_code.co_filename.startswith(SYSTEM_FOLDERS):  # a library on rospy
        advice = f"node.ros_import('{module}')"
    warnings.warn(
        f'rospy.{name} has no node, since nobody calls rospy.init_node(): write {advice}',
        RuntimeWarning,
        stacklevel=3,
    )
