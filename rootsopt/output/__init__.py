"""Result folders, result files, and tables for the terminal."""
