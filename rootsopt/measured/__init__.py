"""Import of a measured or foreign outline: reading it, checking it, making a profile of it."""
