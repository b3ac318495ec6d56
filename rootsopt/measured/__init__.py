"""Import of a drawn or measured outline: read it, check it, make a profile from it."""
