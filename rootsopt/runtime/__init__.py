"""Set-up of the process (environment, precision, threads), compiled programs and their cache."""
