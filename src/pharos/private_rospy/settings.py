"""What one node is to be: name, master, address, ports and remappings, as rospy reads them.

rospy takes them from ``os.environ`` and ``sys.argv``; a node gets private ones, so that no rospy
function need be overridden and the process's own stay untouched.
"""
import os
from typing import List, Optional

import rosgraph.names
from rosgraph.rosenv import ROS_HOSTNAME, ROS_IP, ROS_MASTER_URI, ROS_NAMESPACE

from pharos.private_rospy.addresses import (
    check_domain,
    check_environment,
    check_port,
    default_domain,
    is_same_master,
)
from pharos.private_rospy.arguments import mappings_for, taker_of_name
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.names import NODE_LIMIT, check_name, unique_name
from pharos.private_rospy.parameters import as_stored


class Settings:
    """The settings of one node.

    :param name: node name; '/robot1/driver' carries a namespace, 'driver' is in ROS_NAMESPACE or
        '/'
    :param master_url: URL of the ROS master
    :param domain: address to advertise and, if it is loopback, the only one to listen on; None:
        what ROS_HOSTNAME, ROS_IP or the host's name say
    :param tcp_port: TCPROS port, 0 for any free one
    :param xmlrpc_port: XML-RPC port, 0 for any free one
    :param argv: ROS remappings and private parameters, see :mod:`.arguments`; what is no remapping
        is ignored
    :param shares_connections: whether the node shares connections to publishers elsewhere with
        others of this process
    :raises TypeError: if ``argv`` is no list of strings
    :raises ValueError: if a name, port or address cannot be one, or the value of a private
        parameter
    """

    #: the node in whose namespace its private names are; None: itself
    private_name: Optional[str] = None
    #: whence it has its name, for who may not have that, where the program gives it another
    origin_of_name = ''
    #: what is to be told of its name when it starts
    note = ''

    def __init__(
        self,
        name: str,
        master_url: str,
        domain: Optional[str] = None,
        tcp_port: int = 0,
        xmlrpc_port: int = 0,
        argv: Optional[List[str]] = None,
        shares_connections: bool = False,
    ) -> None:
        self.master_url = master_url
        self.shares_connections = shares_connections
        self.tcp_port = check_port('tcp_port', tcp_port)
        self.xmlrpc_port = check_port('xmlrpc_port', xmlrpc_port)
        arguments = [] if argv is None else argv
        own_base = check_name(name, 'node').rpartition('/')[2]
        for_all, for_one = mappings_for(arguments, own_base)
        mappings = {**for_all, **for_one}
        self.environ = {**os.environ, ROS_MASTER_URI: master_url}
        self._set_domain(domain, mappings)
        given = mappings.get('__ns')
        if given is None and '__log' in for_all:
            # roslaunch, which knows the node by its own idea of the namespace
            given = self.environ.get(ROS_NAMESPACE, '/')
        namespace = _namespace(name, given)
        base = for_one.get('__name', own_base)
        if '__name' in for_all:
            given_name, own_name, taker = for_all['__name'], namespace + base, None
            if '__name' not in for_one:
                taker = taker_of_name(master_url, arguments, given_name, own_name)
            if taker and taker.node == own_name:
                base = given_name
                if given is not None:
                    namespace = _namespace('', given)
            else:
                mappings.pop('__log', None)  # roslaunch has named this file after the other node
                self.note = taker.note(given_name) if taker else ''
        self.base_name = check_name(base, 'node', base=True)
        self.name = check_name(namespace + base, 'node', limit=NODE_LIMIT)
        if base not in (own_base, for_one.get('__name')):
            self.origin_of_name = (
                f', {name!r}, which took it from __name:= in argv, as of a <node> in a launch file'
            )
        self.environ[ROS_NAMESPACE] = namespace.rstrip('/') or '/'
        for left in '__master', '__ns', '__name':  # the settings say this
            mappings.pop(left, None)
        self.argv = [self.base_name, *map(rosgraph.names.REMAP.join, mappings.items())]
        check_private_parameters(self.argv)

    def for_program(self, path, args, env, takes_own_name, private_name):
        """Have them be those of a program that calls ``init_node`` itself.

        :param path: what it finds as ``sys.argv[0]``
        :param env: ``{name: value}`` of further environment variables
        :param takes_own_name: whether it has the name that it gives to ``init_node``; until then it
            has one that is nobody else's
        :param private_name: the node in whose namespace its private names are; None: itself
        :raises ValueError: if one of them cannot be
        """
        check_private_parameters(args)
        mappings = rosgraph.names.load_mappings(args)
        if not is_same_master(mappings.get('__master', self.master_url), self.master_url):
            raise ValueError(
                f"__master:={mappings['__master']} is not obeyed: the script is a node at"
                f' {self.master_url}, whose Master loads it; load it by the Master of the other URL'
            )
        self.argv = [path, *args, *self.argv[1:]]
        if takes_own_name:
            self.name = unique_name(self.name)
        elif '__name' not in mappings:  # which roslaunch gives
            self.argv.append(f'__name{rosgraph.names.REMAP}{self.base_name}')
        if '__name' in rosgraph.names.load_mappings(self.argv):
            # before the nodes that the program creates with its arguments
            taker_of_name(self.master_url, self.argv, None, self.name)
        self.environ.update(env)
        self.private_name = private_name

    def _set_domain(self, domain, mappings):
        """Have rosgraph find the address to advertise, which is checked."""
        if domain is not None:
            self.environ.pop(ROS_IP, None)
            self.environ[ROS_HOSTNAME] = check_domain('domain', domain)
        for argument in '__hostname', '__ip':  # before all others
            if argument in mappings:
                check_domain(argument, mappings[argument])
                return
        if check_environment(self.environ) is None:
            self.environ[ROS_HOSTNAME] = default_domain()  # rosgraph complains of a name in ROS_IP


def _namespace(name, given):
    """The namespace of a node of that name, with a closing slash: its own, within the one given."""
    if given is None:
        given = '/' if name.startswith('/') else os.environ.get(ROS_NAMESPACE, '/')
    if given.strip('/'):
        is_of_environment = given == os.environ.get(ROS_NAMESPACE)
        check_name(given, ROS_NAMESPACE if is_of_environment else 'namespace')
    else:
        given = '/'
    inner = name.lstrip('/').rpartition('/')[0]
    return rosgraph.names.make_global_ns(rosgraph.names.ns_join(given, inner))


def check_private_parameters(arguments):
    """Raise ValueError for the value of a private parameter that the server cannot hold, or that is
    no YAML.

    rospy sets them when the node has registered, one after the other.
    """
    for argument in arguments:
        try:
            parameters = rospy.client.load_command_line_node_params([argument])
        except rospy.ROSInitException as error:
            raise ValueError(
                f'{argument!r} sets no private parameter, for its value is no YAML: put text with'
                f' special characters in quotes ({error})'
            ) from error
        for name, value in parameters.items():
            as_stored('~' + name, value)
