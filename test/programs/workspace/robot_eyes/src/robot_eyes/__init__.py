"""A package with messages and code."""
SEEN = []
