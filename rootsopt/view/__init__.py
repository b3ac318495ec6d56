"""What a run shows: its folder and files, facts, tables, figures and pages."""
