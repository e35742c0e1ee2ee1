"""The ROS nodes in processes of this host: found by the ports on which these listen, ended, and
cleared away."""
import contextlib
import os
import socket
import urllib.parse
import xmlrpc.client

import rosgraph.network

from pharos.private_rospy.proxies import ServerProxy, master_api
from pharos.private_rospy.registration import COMMUNICATION_ERRORS, unregister_all

TIMEOUT = 1.0  # seconds that the master or a node may take to answer

_LISTEN = '0A'  # the state of a socket, in /proc/net/tcp


class ProcessNodes:
    """The nodes at one master that run in given processes.

    Not those of which ``getPid`` says so: on another host, the number is another process's.
    """

    def __init__(self, master_url):
        self._master_url = master_url
        self._ports = set()

    def look(self, pids):
        """See on which ports the processes listen, which cannot be seen of one that has ended."""
        for pid in pids:
            with contextlib.suppress(OSError):  # it has ended, or is another user's
                self._ports |= _listening_ports(pid)

    def shut_down(self):
        """Ask the nodes to end, as ``rosnode kill`` does; returns whether there are any."""
        found = self._registered()
        for uri in found.values():
            # some end before their answer is through
            with contextlib.suppress(*COMMUNICATION_ERRORS):
                ServerProxy(uri, TIMEOUT).shutdown('/pharos', 'its program is to end')
        return bool(found)

    def clear(self):
        """Unregister those that are dead, as ``rosnode cleanup`` does, which asks at a terminal
        whether to."""
        for name, uri in self._registered().items():
            if _is_refused(uri):
                with contextlib.suppress(rosgraph.MasterException, *COMMUNICATION_ERRORS):
                    unregister_all(master_api(self._master_url, name, TIMEOUT), name, uri)

    def _registered(self):
        """``{name: URI}`` of the nodes at the ports that were seen."""
        if not self._ports:
            return {}
        try:
            master = master_api(self._master_url, timeout=TIMEOUT)
            names = sorted(
                {name for kind in master.getSystemState() for _, users in kind for name in users}
            )
            calls = xmlrpc.client.MultiCall(master.handle)
            for name in names:
                calls.lookupNode('/pharos', name)
            uris = [uri for _, _, uri in calls()]
        except (rosgraph.MasterException, *COMMUNICATION_ERRORS):
            return {}  # there is no master to clear anything away from
        return {name: uri for name, uri in zip(names, uris) if uri and self._is_ours(uri)}

    def _is_ours(self, uri):
        address = urllib.parse.urlsplit(uri)
        try:
            port = address.port
        except ValueError:  # the master takes any number from anybody
            return False
        return port in self._ports and rosgraph.network.is_local_address(address.hostname)


def _is_refused(uri):
    address = urllib.parse.urlsplit(uri)
    try:
        socket.create_connection((address.hostname, address.port), TIMEOUT).close()
    except ConnectionRefusedError:
        return True
    except OSError:
        pass  # nobody knows
    return False


def _listening_ports(pid):
    """The TCP ports on which a process listens."""
    inodes = set()
    for descriptor in os.listdir(f'/proc/{pid}/fd'):
        with contextlib.suppress(FileNotFoundError):  # it has just been closed
            link = os.readlink(f'/proc/{pid}/fd/{descriptor}')
            if link.startswith('socket:['):
                inodes.add(link[len('socket:[') : -1])
    ports = set()
    for table in 'tcp', 'tcp6':
        with contextlib.suppress(FileNotFoundError), open(f'/proc/{pid}/net/{table}') as file:
            next(file)
            for line in file:
                _, local, _, state, _, _, _, _, _, inode, *_ = line.split()
                if state == _LISTEN and inode in inodes:
                    ports.add(int(local.rpartition(':')[2], 16))
    return ports
