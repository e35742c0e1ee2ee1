"""SHARED_MEMORY: messages between processes of this package on one host, by files in memory."""
