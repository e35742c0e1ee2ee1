"""What is going on at a master, looked at while it runs; loaded only when used.

- snapshot: one look at hosts, processes, nodes, topics, services and connections

It stands on the facade.
"""
