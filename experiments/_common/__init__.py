"""Code shared by studies: the command line, scenes, calls into rootsopt, tables, style, timing."""
