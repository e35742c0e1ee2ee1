"""INTRAPROCESS: hand messages from node to node of one process, without socket or bytes."""
