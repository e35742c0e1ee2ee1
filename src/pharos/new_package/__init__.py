"""Making a catkin package that is built on this one; loaded only when used."""
