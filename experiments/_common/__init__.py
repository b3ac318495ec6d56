"""What studies share: the command line, scenes, calls into rootsopt, tables, style, timing."""
