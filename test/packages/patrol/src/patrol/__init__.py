"""The nodes of the package patrol, each a class in a module of its own."""
