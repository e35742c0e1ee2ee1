"""Message and service types by their names: looked up, defined, filled, checked."""
