"""What the programs of the report's listings have in common: an address and ports to choose."""
import argparse
from typing import Optional


def parser_of(
    description: Optional[str], tcp_port: Optional[int], xmlrpc_port: int
) -> argparse.ArgumentParser:
    """The parser of a listing's arguments, whose options are keywords of ``Master.create``.

    :param description: what the listing does
    :param tcp_port: the one that the listing has, for ``--help``; None: it has none
    :param xmlrpc_port: likewise
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        '--domain', help='address to advertise, in the listing 127.0.0.1; by default ROS_HOSTNAME'
    )
    for option, port in ('--tcp-port', tcp_port), ('--xmlrpc-port', xmlrpc_port):
        has = 'not in the listing' if port is None else f'in the listing {port}'
        parser.add_argument(option, type=int, default=0, help=f'{has}; by default any free one')
    return parser
