"""What is going on at a master, looked at while it runs; loaded only when used.

- snapshot: one look at hosts, processes, nodes, topics, services and connections
- answers: what the nodes say to that
- watching: Topic.hz, bw, last and watch
- description: Node.describe
- message_text: messages as text, long arrays cut
- workspace: a session in a terminal, with a master, a node and all of pharos at hand

It stands on the facade.
"""
