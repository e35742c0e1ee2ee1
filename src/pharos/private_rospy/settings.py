"""What one node is to be: name, master, address, ports and remappings, as rospy reads them.

rospy takes them from ``os.environ`` and ``sys.argv``; a node gets private ones, so that no rospy function need be
overridden and the process's own stay untouched.
"""
import os

import rosgraph.names
from rosgraph.rosenv import ROS_HOSTNAME, ROS_IP, ROS_MASTER_URI, ROS_NAMESPACE

from pharos.private_rospy.addresses import check_domain, check_environment, check_port, default_domain
from pharos.private_rospy.host import rospy
from pharos.private_rospy.names import check_name
from pharos.private_rospy.parameters import carried


class Settings:
    """The settings of one node.

    :param name: node name; '/robot1/driver' carries a namespace, 'driver' is in ROS_NAMESPACE or '/'
    :param master_url: URL of the ROS master
    :param domain: address to advertise and, if it is loopback, the only one to listen on; None: what
        ROS_HOSTNAME, ROS_IP or the host's name say
    :param tcp_port: TCPROS port, 0 for any free one
    :param xmlrpc_port: XML-RPC port, 0 for any free one
    :param argv: ROS remappings and private parameters; what is no remapping is ignored
    :raises ValueError: if a name, port or address cannot be one, or the value of a private parameter
    """

    def __init__(self, name, master_url, domain=None, tcp_port=0, xmlrpc_port=0, argv=None):
        mappings = [arg for arg in argv or () if rosgraph.names.REMAP in arg and not arg.startswith('__master:=')]
        check_private_parameters(mappings)
        special = rosgraph.names.load_mappings(mappings)
        self.environ = dict(os.environ)
        self.environ[ROS_MASTER_URI] = master_url
        self._set_domain(domain, special)
        namespace, _, base = check_name(name, 'node').rpartition('/')
        if name.startswith('/'):
            self.environ[ROS_NAMESPACE] = namespace or '/'
        elif namespace:
            self.environ[ROS_NAMESPACE] = rosgraph.names.ns_join(rosgraph.names.get_ros_namespace(argv=[]), namespace)
        self.base_name = check_name(special.get('__name', base), 'node', base=True)
        self.namespace = rosgraph.names.get_ros_namespace(self.environ, mappings)
        self.name = self.namespace + self.base_name
        self.argv = [self.base_name, *mappings]
        self.master_url = master_url
        self.tcp_port = check_port('tcp_port', tcp_port)
        self.xmlrpc_port = check_port('xmlrpc_port', xmlrpc_port)

    def _set_domain(self, domain, mappings):
        """Have rosgraph find the address to advertise, which is checked."""
        if domain is not None:
            self.environ.pop(ROS_IP, None)
            self.environ[ROS_HOSTNAME] = check_domain('domain', domain)
        for argument in '__hostname', '__ip':    # before all others
            if argument in mappings:
                check_domain(argument, mappings[argument])
                return
        if check_environment(self.environ) is None:
            self.environ[ROS_IP] = default_domain()


def check_private_parameters(arguments):
    """Raise ValueError for the value of a private parameter that the server cannot hold, or that is no YAML.

    rospy sets them when the node has registered, one after the other.
    """
    for argument in arguments:
        try:
            parameters = rospy.client.load_command_line_node_params([argument])
        except rospy.ROSInitException as error:
            raise ValueError(f'{argument!r} sets no private parameter, for its value is no YAML: put text with special '
                             f'characters in quotes ({error})') from error
        for name, value in parameters.items():
            carried('~' + name, value)
