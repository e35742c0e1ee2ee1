"""Addresses: where a master is, and where a node says that it is."""
import contextlib
import functools
import ipaddress
import re
import socket
import urllib.parse
from typing import Any, MutableMapping, Optional

import rosgraph.network
from rosgraph.rosenv import ROS_HOSTNAME, ROS_IP

_HOST = re.compile(r'\w(?:[\w.-]*\w)?\.?', re.ASCII)  # Docker's names have underscores
_URL = re.compile(rf'http://({_HOST.pattern}|\[[^]]+\]):(\d{{1,9}})/?', re.ASCII | re.IGNORECASE)
_LOOPBACK_IPV6 = ipaddress.ip_address('::1')
# '5' is one of the first, multicast and broadcast are the others
_UNREACHABLE = [
    ipaddress.ip_network(network)
    for network in ('0.0.0.0/8', '224.0.0.0/4', '255.255.255.255', '::', 'ff00::/8')
]


def check_port(what: str, port: Any) -> int:
    """``port`` if it is one, else ValueError."""
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port <= 65535:
        raise ValueError(f'{what} must be a port number, 0 (any free one) to 65535, not {port!r}')
    return port


def check_url(url: Any, source: str = '') -> str:
    """``url`` if it can be a master's, else ValueError; written as URLs should be, with a closing
    slash.

    :param source: the variable of the environment that it comes from, if it does
    """
    match = _URL.fullmatch(url) if isinstance(url, str) else None
    if match and 0 < int(match[2]) <= 65535:
        host = match[1].lower()
        if not host.startswith('[') or _is_ipv6(host[1:-1]):
            return f'http://{host}:{int(match[2])}/'
    where = f'{source} is {url!r}, which' if source else repr(url)
    raise ValueError(
        f'{where} is not the URL of a ROS master: it looks like http://127.0.0.1:11311/'
    )


def check_domain(what: str, domain: Any) -> str:
    """``domain`` if other nodes can be told to come there, else ValueError.

    :param what: where it comes from: the parameter of that name, or a variable of the environment
    """
    advice = 'give a host name or an IPv4 address of this host, such as robot1 or 192.168.1.5'
    if _is_ipv6(domain):
        raise ValueError(
            f'{what} cannot be {domain!r}, for ROS puts no IPv6 address into a URL: {advice}; with '
            'ROS_IPV6=on the name may be one of an IPv6 address'
        )
    if not isinstance(domain, str) or not _HOST.fullmatch(domain):
        raise ValueError(f'{what} cannot be {domain!r}: {advice}, without http:// and port')
    try:
        found = addresses_of(
            domain, socket.AF_UNSPEC if rosgraph.network.use_ipv6() else socket.AF_INET
        )
    except (OSError, UnicodeError) as error:
        raise ValueError(
            f'{what} {domain!r} does not resolve ({error}), so that nobody would reach the node: '
            f'{advice}'
        ) from error
    for address in found:
        if any(address in network for network in _UNREACHABLE):
            raise ValueError(
                f'{what} {domain!r} means {address}, at which nobody would reach the node: {advice}'
            )
    return domain


def check_environment(environ: MutableMapping[str, str]) -> Optional[str]:
    """The address that the environment gives, None if it gives none; else ValueError.

    Takes empty variables away: rosgraph takes them for an answer, and that for none.
    """
    given = None
    for variable in ROS_HOSTNAME, ROS_IP:
        if not environ.get(variable):
            environ.pop(variable, None)
        elif given is None:
            given = check_domain(variable, environ[variable])
    return given


def default_domain() -> str:
    """What a node says where nothing else is said: the host's name, or its address where the name
    does not resolve.

    rosgraph says the name, and nobody reaches the node.
    """
    try:
        return check_domain("the host's name", socket.gethostname())
    except ValueError:
        return rosgraph.network.get_local_address()


def loopback() -> str:
    """An address for this host alone; with ROS_IPV6=on, a name of ::1, or what
    :func:`default_domain` says where there is none."""
    if not rosgraph.network.use_ipv6():
        return '127.0.0.1'
    return 'localhost' if _LOOPBACK_IPV6 in addresses_of('localhost') else default_domain()


def is_same_master(url: str, other: str) -> bool:
    """Whether two URLs as of :func:`check_url` mean one address; looks host names up, once, but
    never connects."""
    if url == other:
        return True
    one, two = urllib.parse.urlsplit(url), urllib.parse.urlsplit(other)
    try:
        return one.port == two.port and not _of_master(one.hostname).isdisjoint(
            _of_master(two.hostname)
        )
    except (OSError, UnicodeError):
        # what cannot be looked up is the same only where it is spelt so
        return False


@functools.lru_cache(maxsize=1000)
def _of_master(host):
    """The addresses of a host; this one has a master at all of its own."""
    # a client that connects to 0.0.0.0 or :: connects here
    own_names = ['localhost', socket.gethostname(), '0.0.0.0', '::']
    found, here = addresses_of(host), set()
    for own in own_names + rosgraph.network.get_local_addresses():
        with contextlib.suppress(OSError, UnicodeError):
            here |= addresses_of(own)
    return found if found.isdisjoint(here) else found | here


def addresses_of(host, family=socket.AF_UNSPEC):
    """The IP addresses of a host, given by its name or one of them, as of :mod:`ipaddress`.

    :raises OSError, UnicodeError: if the name has none
    """
    return {
        ipaddress.ip_address(found[0].partition('%')[0])
        for *_, found in socket.getaddrinfo(host, None, family, socket.SOCK_STREAM)
    }


def _is_ipv6(host):
    try:
        return isinstance(host, str) and ipaddress.ip_address(host).version == 6
    except ValueError:
        return False
