"""What is going on at a master, looked at while it runs; loaded only when used.

- snapshot: one look at hosts, processes, nodes, topics, services and connections
- answers: what the nodes say to that
- watching: Topic.hz, bw, last and watch
- description: Node.describe
- message_text: messages as text, long arrays cut
- workspace: a session in a terminal, with a master, a node and all of pharos at hand
- graph: Graph, the picture of a snapshot; edges: its arrows; dot: as a text for graphviz; graphviz: which
  draws it; graph_text: for a terminal
- pictures: messages of which a picture says more; images, from_above: how they are drawn
- plot: InputChannel.plot
- colors: those of pictures and plots
- failure_table: Node.failures as a table; debugger: Failure.debug
- top, top_table, top_screen: rosrun pharos top; terminal: its keys and signals; probing: --measure
- completion, explanation, mistakes, notebook: what completes, explains and shows things there

It stands on the facade.
"""
