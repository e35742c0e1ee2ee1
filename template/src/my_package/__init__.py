"""The nodes of the package my_package, each a class in a module of its own."""
