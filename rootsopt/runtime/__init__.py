"""Process and programs: precision, environment, threads, compiled programs and their cache."""
