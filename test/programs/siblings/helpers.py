"""What the program beside it counts with."""
COUNT = []
