"""Names: what is resolved is not remapped once more."""
from pharos.private_rospy.names import Resolved
from pharos.private_rospy.patches.table import patch


@patch('rospy.names', 'resolve_name', 'remaps once more what is resolved already')
def resolve_name(name, caller_id=None, *, node, original):
    """Leave alone what says that it is resolved; find private names where the settings say."""
    if isinstance(name, Resolved):
        return str(name)
    return original(name, caller_id or node.settings.private_name)


@patch(
    'rospy.topics',
    '_TopicImpl.__init__',
    'resolves what is resolved already: Topic and _TopicImpl differ where remappings swap names',
)
def init_topic(self, name, data_class, *, original):
    """Take the name as resolved."""
    original(self, Resolved(name), data_class)
