"""Import of a drawn or measured outline: read the file, check it, make a profile from it."""
