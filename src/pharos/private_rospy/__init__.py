"""A rospy of its own for each node: loaded once more, patched, started and stopped."""
