"""Environment, precision and threads of the process; compiled programs and their cache."""
