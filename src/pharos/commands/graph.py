"""The command graph."""
from __future__ import annotations

import json

from pharos.commands import argument_parser
from pharos.live.graph import graph_of
from pharos.master import Master


def graph(arguments: list[str]) -> None:
    """Show the graph of the ROS master: processes, nodes, topics, and their links.

    graph                            as text
    graph --output graph.svg         as a picture: .svg, .png, .pdf (by graphviz) or .dot
    graph --rates 2                  with messages a second, counted for 2 s
    graph --only '/arm|/joint_states'    nodes and topics with one of these texts in their names
    graph --hide '^/tf'              all but nodes and topics that match the regular expression
    graph --json                     for a program
    watch -n1 rosrun pharos graph    again and again
    """
    parser = argument_parser(graph)
    parser.add_argument('--output', help='save a picture')
    parser.add_argument('--rates', type=float, default=0, help='count messages for so many s')
    parser.add_argument(
        '--only', default='', help='leave out names without this regular expression'
    )
    parser.add_argument('--hide', default='^$', help='leave out names with it')
    parser.add_argument('--json', action='store_true', help='print JSON')
    options = parser.parse_args(arguments)
    ros_graph = graph_of(Master(), options.rates, only=options.only, hide=options.hide)
    if options.output:
        ros_graph.save(options.output)
    elif options.json:
        print(json.dumps(ros_graph.as_dict()))
    else:
        print(ros_graph.text())
