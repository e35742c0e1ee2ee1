"""Several hosts on this one: network namespaces, each with an address and a name, on a network of
their own."""
import contextlib
import os
import pathlib
import secrets
import shutil
import subprocess
import sys

import pytest

from programs import Program

NETWORK = '10.77.0.%d'
MASTER_PORT = 11311  # of a host's own: nobody else is there
# `ip netns exec` shows a namespace its files there in place of /etc
CONFIGURATION = pathlib.Path('/etc/netns')


def ip(*arguments):
    """Run the program ip; an error says what it said."""
    ended = subprocess.run(['ip', *arguments], capture_output=True, text=True, check=False)
    if ended.returncode:
        raise OSError(f"ip {' '.join(arguments)}: {ended.stderr.strip()}")


class Host:
    """A network namespace with an address and a name that the others know."""

    def __init__(self, network, name, number):
        self.name, self.address, self.domain = name, NETWORK % number, name + '.pharos.test'
        self.namespace, self._switch, self._port = (
            f'{network}-{name}',
            f'{network}-switch',
            'to-' + name,
        )

    def plug_in(self, hosts):
        """Join it to the switch; ``hosts`` is the text of its /etc/hosts."""
        folder = CONFIGURATION / self.namespace
        folder.mkdir(parents=True)
        (folder / 'hosts').write_text(hosts)
        ip(
            '-n',
            self._switch,
            'link',
            'add',
            self._port,
            'type',
            'veth',
            'peer',
            'name',
            'eth0',
            'netns',
            self.namespace,
        )
        ip('-n', self._switch, 'link', 'set', self._port, 'master', 'bridge', 'up')
        ip('-n', self.namespace, 'address', 'add', self.address + '/24', 'dev', 'eth0')
        for device in 'lo', 'eth0':
            ip('-n', self.namespace, 'link', 'set', device, 'up')

    def link(self, state):
        """Take the link to the switch 'down', or 'up' again: the host itself is told as little as
        by a bad cable."""
        ip('-n', self._switch, 'link', 'set', self._port, state)

    def forget_neighbours(self):
        """Have it ask for the others' hardware addresses again, without which it soon knows that
        they are gone."""
        ip('-n', self.namespace, 'neighbour', 'flush', 'dev', 'eth0')

    def command(self, *command):
        """The command that runs this one on the host."""
        return ('ip', 'netns', 'exec', self.namespace, *command)

    def start(self, master, *command, **variables):
        """A Program that runs there, at the ROS master on the host ``master``."""
        url = 'http://%s:%d/' % (master.address, MASTER_PORT)
        return Program(url, *self.command(*command), **{'ROS_HOSTNAME': self.address, **variables})

    def python(self, master, code, *arguments, **variables):
        """The same, for a program in Python."""
        return self.start(master, sys.executable, '-c', code, *arguments, **variables)


@contextlib.contextmanager
def network(*names):
    """The hosts of those names, on a network of their own; they are gone at the end.

    Skips the test where there can be none, and says why.
    """
    if os.geteuid() != 0 or shutil.which('ip') is None:
        pytest.skip('needs root and the program ip, for network namespaces')
    network_name = f'pharos-{secrets.token_hex(4)}'
    hosts = [Host(network_name, name, number) for number, name in enumerate(names, 1)]
    namespaces = [f'{network_name}-switch', *(host.namespace for host in hosts)]
    table = '127.0.0.1 localhost\n' + ''.join(f'{host.address} {host.domain}\n' for host in hosts)
    try:
        try:
            for namespace in namespaces:
                ip('netns', 'add', namespace)
            ip('-n', namespaces[0], 'link', 'add', 'bridge', 'type', 'bridge')
            ip('netns', 'exec', namespaces[0], 'true')
        except OSError as error:
            pytest.skip(f'no network namespaces here: {error}')
        ip('-n', namespaces[0], 'link', 'set', 'bridge', 'up')
        for host in hosts:
            host.plug_in(table)
        yield hosts
    finally:
        for namespace in namespaces:
            with contextlib.suppress(OSError):
                ip('netns', 'delete', namespace)
            shutil.rmtree(CONFIGURATION / namespace, ignore_errors=True)
        with contextlib.suppress(OSError):
            CONFIGURATION.rmdir()  # if it is empty
