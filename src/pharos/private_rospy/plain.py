"""Plain rospy in a program whose nodes are made with pharos: it says what to write instead."""
import sys

FUNCTIONS = (
    'loginfo logwarn logerr logdebug logfatal loginfo_once logwarn_once logerr_once get_param'
    ' set_param has_param search_param get_name get_namespace on_shutdown wait_for_message'
).split()
_SYSTEM_FOLDERS = '/usr/', '/opt/ros/'


def guide(rospy, nodes):
    """Have functions and classes of rospy say once what to write, if rospy has no node.

    ``rospy.is_shutdown()`` is then True when all nodes have stopped.

    :param rospy: the process's own rospy, or that of a composed program
    :param nodes: ``nodes()`` returns the nodes of pharos that start or run
    """
    told = set()  # what to write, and '' when there have been nodes

    def watch(owner, attribute):
        original = getattr(owner, attribute)

        def call(*args, **kwargs):
            if rospy.core.is_initialized():
                setattr(owner, attribute, original)  # or the log would name this file
            elif nodes():
                _tell(type(args[0]).__name__ if attribute == '__init__' else attribute, told)
            return original(*args, **kwargs)

        setattr(owner, attribute, call)

    def is_shutdown(original=rospy.is_shutdown):
        if nodes():
            told.add('')
        elif told and not rospy.core.is_initialized():
            return True
        return original()

    rospy.is_shutdown = rospy.core.is_shutdown = is_shutdown
    for name in FUNCTIONS:
        watch(rospy, name)
    for cls in rospy.topics.Topic, rospy.Service, rospy.ServiceProxy:
        watch(cls, '__init__')


def _tell(name, told):
    """Print what to write instead of a call of rospy, once for each name."""
    frame = sys._getframe(2)
    if name in FUNCTIONS and frame.f_globals['__name__'].startswith('rospy'):
        return  # a class of rospy has called, and has been told of
    while frame.f_globals.get('__name__', '').startswith(('rospy', 'pharos')):
        frame = frame.f_back
    advice = f'node.ros.{name}'
    if frame.f_code.co_filename.startswith(_SYSTEM_FOLDERS):  # a library on rospy
        library = frame.f_globals['__name__'].partition('.')[0]
        advice = f"node.ros_import('{library}')"
    if advice not in told:
        told.add(advice)
        print(
            f'rospy.{name} has no node, since nobody calls rospy.init_node(): write {advice}',
            file=sys.stderr,
        )
