"""Set-up of the process, and compiled programs: environment, precision, threads, cache, timing."""
