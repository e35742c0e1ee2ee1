"""The command graph."""
from __future__ import annotations

from pharos.commands import argument_parser
from pharos.live.graph import graph_of
from pharos.master import Master


def graph(arguments: list[str]) -> None:
    """Show the graph of the ROS master: processes, nodes, topics, and their links.

    graph                            as text
    graph --output graph.svg         as a picture: .svg, .png, .pdf (by graphviz) or .dot
    graph --rates 2                  with messages a second, counted for 2 s
    watch -n1 rosrun pharos graph    again and again
    """
    parser = argument_parser(graph)
    parser.add_argument('--output', help='save a picture')
    parser.add_argument('--rates', type=float, default=0, help='count messages for so many s')
    options = parser.parse_args(arguments)
    ros_graph = graph_of(Master(), options.rates)
    if options.output:
        ros_graph.save(options.output)
    else:
        print(ros_graph.text())
