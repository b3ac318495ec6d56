"""The work of each command. A module here is loaded once its config has been accepted, so that help
and messages about a wrong config need no solver."""
