"""Result folders, files and tables."""
