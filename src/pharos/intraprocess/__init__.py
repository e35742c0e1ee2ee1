"""INTRAPROCESS: how messages and service calls get from one node of this process to another."""
